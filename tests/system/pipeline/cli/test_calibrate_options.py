"""What the commands of `colorphase calibrate` share."""

from pathlib import Path

import pytest

from pipeline.cli.calibrate import captures_and_target
from pipeline.cli.project import BoardOptions
from pipeline.errors import SettingsError


def test_a_board_of_another_size_keeps_its_markers_share():
    options = BoardOptions("9x6", square_mm=20.0, marker_mm=14.0).with_square(30.0)
    assert options.board("charuco").square_mm == 30 and options.board("charuco").marker_mm == 21
    assert BoardOptions().with_square(30.0).marker_mm is None
    with pytest.raises(SettingsError, match="marker_mm must be less than square_mm"):
        BoardOptions(square_mm=20.0, marker_mm=21.0).board("charuco")


def test_captures_without_a_target_are_refused():
    assert captures_and_target(Path("a"), Path("b")) == (Path("a"), Path("b"))
    with pytest.raises(SettingsError, match="--make and a folder, or a folder of captures and --out"):
        captures_and_target(Path("a"), None)
