"""Three words for an error."""

from pipeline.calibration.verdict import grade_of


def test_what_lies_on_a_bound_still_has_the_better_grade():
    assert [grade_of(error, 1.0, 2.0) for error in (1.0, 1.1, 2.0, 2.1)] == ["good", "usable", "usable", "poor"]


def test_an_unknown_error_is_poor():
    assert grade_of(float("nan"), 1.0, 2.0) == "poor"
