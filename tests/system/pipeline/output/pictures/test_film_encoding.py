"""Films: their colours, and parts that are joined."""

import av
import numpy as np
import pytest
from support.drawn_surfaces import read_film

from pipeline.footage.opening import open_source
from pipeline.output.film import FilmEncoder, join_parts
from tikernels.raw.development import develop


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
@pytest.mark.parametrize("size", [(160, 120), (1280, 960)])
def test_colors_are_those_that_were_drawn(tmp_path, monkeypatch, codec, size, cpu):
    """Whatever a player guesses of a file that does not say its matrix; to 3 grey levels."""
    monkeypatch.setattr(av, "codecs_available", {codec})
    color = (220, 60, 40)
    with FilmEncoder(tmp_path / "part.mp4", size, 30) as encoder:
        encoder.add(np.full((*size[::-1], 3), color, np.uint8))
    assert encoder.codec == codec
    join_parts([(tmp_path / "part.mp4", 1)], tmp_path / "film.mp4", 30)
    source = open_source(tmp_path / "film.mp4")
    (frame,) = source.frames()
    assert source.notes == ()
    np.testing.assert_allclose(255 * develop(frame.planes, frame.format)[size[1] // 2, size[0] // 2], color, atol=3)


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
@pytest.mark.parametrize("fps", [30, 12.5, 29.97])
def test_joined_parts_are_one_film_without_a_gap(tmp_path, monkeypatch, codec, fps):
    monkeypatch.setattr(av, "codecs_available", {codec})
    levels, parts = [], []
    for number, length in enumerate((5, 1, 7)):
        parts.append((tmp_path / f"{number}.mp4", length))
        with FilmEncoder(parts[-1][0], (64, 48), fps) as encoder:
            for _ in range(length):
                levels.append(10 * len(levels) + 40)
                encoder.add(np.full((48, 64, 3), levels[-1], np.uint8))
    join_parts(parts, tmp_path / "film.mp4", fps)
    seen, rate = read_film(tmp_path / "film.mp4")
    assert rate == pytest.approx(fps, rel=1e-3)
    np.testing.assert_allclose(seen.mean(axis=(1, 2, 3)), levels, atol=6)
    with av.open(str(tmp_path / "film.mp4")) as film:
        stream = film.streams.video[0]
        times = [float(frame.pts * stream.time_base) for frame in film.decode(video=0)]
        np.testing.assert_allclose(times, np.arange(13) / fps, atol=1e-3)
