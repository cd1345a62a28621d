"""Files of a MuJoCo model: where `xml_file` finds it, and what it includes."""

import hashlib
import html
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import gymnasium

from mjx_walk.storage.files import open_to_read, user_path

__all__ = ["ASSETS", "absolute_xml_file", "changed_names", "is_asset", "model_path", "source_hashes"]

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
"""Gymnasium's models."""

_ATTRIBUTE = re.compile(r"""([\w:.-]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")
_TAG = re.compile(r"""<!--.*?-->|<!\[CDATA\[.*?\]\]>|<!.*?>|<([\w:.-]+)((?:[^<>"']|"[^"]*"|'[^']*')*)>""", re.DOTALL)
"""A comment, text in CDATA or a declaration; or a tag and its attributes."""
_FILE = re.compile("file(name|right|left|up|down|front|back)?")
"""Attributes that name a file."""
_REFERENCE = re.compile(r"&(?:#\d+|#x[0-9a-fA-F]+|amp|lt|gt|quot|apos);")
_FOLDERS = {"mesh": "meshdir", "flexcomp": "meshdir", "texture": "texturedir"}
"""The compiler's attribute for the folder of an element's file."""


def model_path(xml_file: str) -> Path:
    """Path of a model, found as Gymnasium finds it.

    The name of one of Gymnasium's assets is that asset, even if the working directory has such a file. With a leading
    `.`, `/` or `~` it is a path. Gymnasium refuses other names; here they are relative to the working directory.
    """
    return ASSETS / xml_file if is_asset(xml_file) else user_path(xml_file)


def is_asset(xml_file: str) -> bool:
    """Whether `xml_file` is the name of one of Gymnasium's assets."""
    return not xml_file.startswith((".", "/", "~")) and (ASSETS / xml_file).is_file()


def absolute_xml_file(xml_file: str, folder: Path) -> str:
    """An `xml_file` that stays the same model in another working directory.

    Names of assets and of missing files stay as they are. Links stay, because MuJoCo looks for included files beside
    them.

    Args:
        xml_file: name of one of Gymnasium's assets, or a path.
        folder: what a relative path is relative to.
    """
    path = os.path.abspath(folder / user_path(xml_file))  # MuJoCo reads `..` in the text of a path, too
    return xml_file if is_asset(xml_file) or not os.path.isfile(path) else path


def source_hashes(model_file: str) -> dict[str, str]:
    """SHA-256 of all files that MuJoCo reads for a model.

    These are the XML file, its includes and submodels at any depth, and the meshes, textures, height fields and skins
    of all of them.

    Args:
        model_file: as `xml_file`, of a model that MuJoCo has read.

    Returns:
        The hashes, by the paths relative to the model's folder. A file that the XML names with an absolute path has
        this path.
    """
    path = Path(os.path.abspath(model_path(model_file)))
    names: dict[str, None] = {}
    _find_sources(path.parent, path.name, names)
    return {name: _hash(path.parent / name) for name in names}


def changed_names(before: Mapping[str, str], present: Mapping[str, str]) -> list[str]:
    """Names of files whose hashes differ, or that one of both lacks."""
    return [name for name in {**before, **present} if before.get(name) != present.get(name)]


def _hash(path: Path) -> str:
    with open_to_read(path) as file:
        return hashlib.sha256(file.read()).hexdigest()


def _find_sources(root: Path, name: str, found: dict[str, None]) -> None:
    """Add a model's files to those that are found: names relative to the root."""
    if name in found:
        return
    folder = os.path.dirname(name)
    tags: list[tuple[str, str, dict[str, str]]] = []
    _read_tags(root, folder, name, tags, found)
    compiler = _compiler_settings(tags)
    is_stripped = compiler.get("strippath") == "true"
    for place, tag, attributes in tags:
        if tag in ("include", "compiler"):
            continue
        searched = os.path.join(folder, compiler.get(_FOLDERS.get(tag, "assetdir"), ""))
        opened = os.path.join(folder, compiler.get("texturedir" if tag == "texture" else "meshdir", ""))
        for value in (value for key, value in attributes.items() if _FILE.fullmatch(key)):
            if tag == "model":
                submodel = _first_file(root, (folder, place), value)
                if submodel:
                    _find_sources(root, submodel, found)
                continue
            asset = os.path.basename(value) if is_stripped else value.removeprefix("package://")
            is_beside = place != folder and not (root / searched / asset).is_file()  # beside an included file
            source = _first_file(root, ([place] if is_beside else []) + [opened, searched, folder], asset)
            found |= {source: None} if source else {}


def _compiler_settings(tags: Iterable[tuple[str, str, dict[str, str]]]) -> dict[str, str]:
    """Attributes of all `<compiler>`, the last ones. `assetdir` replaces the other folders of earlier ones."""
    settings: dict[str, str] = {}
    for _, tag, attributes in tags:
        if tag == "compiler" and "assetdir" in attributes:
            settings |= dict.fromkeys(("meshdir", "texturedir"), attributes["assetdir"])
        settings |= attributes if tag == "compiler" else {}
    return settings


def _read_tags(
    root: Path, folder: str, name: str, tags: list[tuple[str, str, dict[str, str]]], found: dict[str, None]
) -> None:
    """Read the tags of an XML file and of its includes, in order: the file's folder, the tag, its attributes.

    MuJoCo's parser reads more than Python's does, so that the text is scanned.
    """
    found[name] = None
    place = os.path.dirname(name)
    text = (root / name).read_bytes().decode("utf-8", "surrogateescape")
    for tag, content in _TAG.findall(text):  # with comments and text, whose tag is empty
        attributes = {
            key: _unescape(double or single).replace("\\", "/")  # MuJoCo takes both for a separator
            for key, double, single in _ATTRIBUTE.findall(content)
        }
        tags.append((place, tag, attributes))
        if tag == "include" and "file" in attributes:
            source = _first_file(root, (folder, place), attributes["file"])
            if source and source not in found:
                _read_tags(root, folder, source, tags, found)


def _unescape(text: str) -> str:
    """Text without XML's references. Python's `html` knows more names than XML has."""
    return _REFERENCE.sub(lambda found: html.unescape(found[0]), text)


def _first_file(root: Path, folders: Iterable[str], name: str) -> str | None:
    """The first of the folders' files of a name that exists."""
    names = (os.path.normpath(os.path.join(folder, name)) for folder in folders)
    return next((found for found in names if (root / found).is_file()), None)
