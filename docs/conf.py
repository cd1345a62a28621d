"""Sphinx configuration of the documentation site. The build needs no network."""

import posixpath
import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import generate
from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

import mjx_walk

project = "mjx_walk"
author = "The mjx_walk authors"
copyright = "The mjx_walk authors"
version = release = mjx_walk.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
exclude_patterns = ["examples"]

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"
autoclass_content = "both"
default_role = "code"
"""Docstrings mark code with single backticks."""

highlight_language = "none"
"""Of blocks that name no language: commands."""

html_theme = "furo"
html_title = "mjx_walk"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_math_renderer = "mathml"
"""Browsers draw MathML themselves. MathJax would be loaded from a server."""

_ROOT_PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md"}
"""Files at the top of the repository that the site shows as pages."""


def _link_from(folder: str, docname: str, target: str) -> str:
    """A link of a Markdown file, rewritten for a page of the site.

    Args:
        folder: of the Markdown file, relative to the repository.
        docname: of the page that shows it.
        target: of the link, relative to the file.
    """
    path, hash_sign, heading = target.partition("#")
    if not path or "://" in path:
        return target
    path = posixpath.normpath(posixpath.join(folder, path))
    path = posixpath.join("docs", _ROOT_PAGES[path]) if path in _ROOT_PAGES else path
    return posixpath.relpath(path, posixpath.dirname(posixpath.join("docs", docname))) + hash_sign + heading


def _with_links(folder: str, docname: str, text: str) -> str:
    return re.sub(r"\]\(([^)\s]+)\)", lambda match: f"]({_link_from(folder, docname, match[1])})", text)


def _adapt_page(app, docname: str, source: list[str]) -> None:
    source[0] = _with_links(posixpath.dirname(posixpath.join("docs", docname)), docname, source[0])


def _adapt_included(app, path, docname: str, source: list[str]) -> None:
    source[0] = _with_links(posixpath.dirname(posixpath.normpath(posixpath.join("docs", path))), docname, source[0])


def _show_inline_math(translator, node) -> None:
    translator.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _show_math(translator, node) -> None:
    translator.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app) -> None:
    app.connect("builder-inited", lambda app: generate.write())
    app.add_html_math_renderer("mathml", (_show_inline_math, None), (_show_math, None))
    app.connect("source-read", _adapt_page)
    app.connect("include-read", _adapt_included)
