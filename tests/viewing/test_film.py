"""Films during training."""

import struct

import imageio.v3 as iio
import imageio_ffmpeg
import pytest
from helpers import TINY, TINY_CALL, command, renders
from tensorboardX.proto.event_pb2 import Event

from mjx_walk import api
from mjx_walk.settings.config import load_config
from mjx_walk.storage.run_folder import RunFolder
from mjx_walk.viewing import rendering
from mjx_walk.viewing.film import Filmer


def films_in_tensorboard(run_dir):
    """Steps and GIFs of all images in all event files, which are TFRecords: size, checksum, data, checksum."""
    found = {}
    for path in run_dir.glob("events.*"):
        data, at = path.read_bytes(), 0
        while at < len(data):
            (size,) = struct.unpack_from("<Q", data, at)
            event = Event.FromString(data[at + 12 : at + 12 + size])
            at += 16 + size
            for value in event.summary.value:
                if value.tag == "film":
                    found[event.step] = value.image.encoded_image_string
    return found


@renders
@pytest.mark.slow
def test_evaluations_are_filmed(tmp_path):
    calls = 30
    done = command(
        "train", *TINY, f"run_dir={tmp_path}/run", f"total_steps={calls * TINY_CALL}", "evaluation.films=true"
    )
    assert done.returncode == 0, done.stderr
    films = sorted((tmp_path / "run" / "films").iterdir())
    assert films and {film.suffix for film in films} == {".mp4"}  # what they were made from is gone
    shown = films_in_tensorboard(tmp_path / "run")
    evaluated = {row["env_steps"] for row in api.load_run(tmp_path / "run").metrics if "eval/return" in row}
    assert {int(film.stem) for film in films} == set(shown) <= evaluated
    for film in films:
        frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(film))
        assert frames > 5 and seconds > 0.2
        gif = iio.imread(shown[int(film.stem)], extension=".gif", index=None)
        assert gif.shape[1:] == (240, 320, 3) and len(gif) == -(-frames // 2)


def test_a_film_that_cannot_be_written_is_no_error(tmp_path, caplog):
    (tmp_path / "films").write_text("a file")
    Filmer(load_config([*TINY, "hardware=cpu"]), RunFolder(tmp_path)).take({}, 5)
    assert f"cannot film step 5 of {tmp_path}: " in caplog.text


def test_where_nothing_renders_nothing_is_begun(tmp_path, monkeypatch):
    monkeypatch.setattr(rendering, "_works", lambda name: False)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with pytest.raises(rendering.UserError, match="nothing to render with"):
        api.run([*TINY, f"run_dir={tmp_path}/run", "evaluation.films=true"])
    assert not (tmp_path / "run").exists()
