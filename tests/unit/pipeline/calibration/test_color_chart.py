"""Wavelengths from a colour chart."""

import numpy as np
import pytest

from pipeline.calibration import Calibration
from pipeline.calibration.color_chart import chart_codes, chart_sequence, measure_wavelengths, read_spectra
from pipeline.errors import CalibrationError

NM = np.arange(400.0, 701.0, 10)
TRUE = np.array([[625.0, 553, 462], [622, 536, 468], [628, 515, 462]])
CROSSTALK = np.array([[0.7, 0.2, 0.02], [0.08, 0.75, 0.15], [0.03, 0.1, 0.8]])
CORNERS = np.array([[40.0, 35], [290, 30], [285, 190], [45, 185]])
SIZE = (220, 330)
NAMES = chart_sequence((64, 48)).names


def spectra() -> np.ndarray:
    """Return a table of 24 patches: steps up, steps down, bells and greys."""
    rise = [0.06 + 0.7 / (1 + np.exp(-(NM - place) / 15)) for place in np.linspace(430, 650, 7)]
    fall = [0.06 + 0.7 / (1 + np.exp((NM - place) / 15)) for place in np.linspace(440, 660, 7)]
    bells = [0.08 + 0.5 * np.exp(-0.5 * ((NM - place) / 35) ** 2) for place in (450, 500, 540, 600)]
    greys = [np.full(len(NM), value) for value in (0.9, 0.6, 0.36, 0.2, 0.09, 0.05)]
    return np.column_stack([NM, *rise, *fall, *bells, *greys])


def photograph(*, shadow: int | None = None, order: np.ndarray | None = None, light: float = 200.0) -> dict:
    """Return the four captures of a chart that is lit more on one side, 8 bits with noise."""
    table, rng = spectra(), np.random.default_rng(3)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    column, row = np.clip(np.rint((x - 42) / 49), 0, 5), np.clip(np.rint((y - 33) / 51.5), 0, 3)
    patch = (6 * row + column).astype(int)
    shown = patch if order is None else order[patch]
    captures = {}
    for j, name in enumerate(NAMES):
        image = np.full((*SIZE, 3), 6.0)
        if j:
            for i in range(3):
                rho = np.array([np.interp(TRUE[i, j - 1], NM, own) for own in table[:, 1:].T])
                image[..., i] += light * CROSSTALK[i, j - 1] * rho[shown] * np.exp(0.001 * x - 0.0006 * j * y)
            if shadow is not None:
                image[patch == shadow] = 6 + 0.5 * (image[patch == shadow] - 6)
        captures[name] = np.clip(np.rint(image + rng.standard_normal(image.shape)), 0, 255).astype(np.uint8)
    return captures


def test_all_nine_are_found():
    """To 3 nm, but for the channels that see next to nothing of a primary, which say so."""
    found = measure_wavelengths(photograph(), CORNERS, spectra())
    assert np.abs(found.wavelengths_nm - TRUE)[CROSSTALK > 0.05].max() <= 3
    assert (np.abs(found.wavelengths_nm - TRUE) < 3 * found.sigma_nm + 3).all()
    assert found.misfit < 0.06
    assert found.sigma_nm[0, 2] > found.sigma_nm[2, 2]
    kept = found.add_to(Calibration(crosstalk_matrix=CROSSTALK))
    np.testing.assert_array_equal(kept.wavelengths_nm, found.wavelengths_nm)


def test_the_pictures_are_black_and_the_primaries():
    assert NAMES == ("0-black", "1-red", "2-green", "3-blue")
    np.testing.assert_array_equal([chart_codes(name) for name in NAMES], np.eye(4, 3, -1))


def test_a_chart_that_is_none_is_refused():
    order = np.random.default_rng(1).permutation(24)
    with pytest.raises(CalibrationError, match=r"off their spectra by .* name the corners in the order"):
        measure_wavelengths(photograph(order=order), CORNERS, spectra())
    with pytest.raises(CalibrationError, match="off their spectra by"):
        measure_wavelengths(photograph(), CORNERS[[1, 2, 3, 0]], spectra())


def test_a_patch_in_shadow_is_named():
    with pytest.raises(CalibrationError, match=r"patch 9 \(row 2, column 3\) is 4\d% darker than its spectrum says"):
        measure_wavelengths(photograph(shadow=8), CORNERS, spectra())


def test_light_that_is_too_little_or_too_much_is_refused():
    with pytest.raises(CalibrationError, match="1-red is hardly brighter than 0-black: expose longer"):
        measure_wavelengths(photograph(light=8), CORNERS, spectra())
    with pytest.raises(CalibrationError, match=r"is at full scale in patch .*: expose shorter"):
        measure_wavelengths(photograph(light=600), CORNERS, spectra())


def test_corners_outside_the_picture_are_refused():
    with pytest.raises(CalibrationError, match="lies outside the picture"):
        measure_wavelengths(photograph(), CORNERS + np.array([100, 0]), spectra())


def write_table(path, table: np.ndarray) -> None:
    lines = ["nm," + ",".join(f"patch {k}" for k in range(1, table.shape[1])), "# made for a test"]
    path.write_text("\n".join(lines + [",".join(f"{value:.4f}" for value in row) for row in table]) + "\n")


def test_a_table_of_spectra_is_read(tmp_path):
    write_table(tmp_path / "chart.csv", spectra())
    np.testing.assert_allclose(read_spectra(tmp_path / "chart.csv"), spectra(), atol=1e-4)


@pytest.mark.parametrize("separator", [";", "; ", "\t", "  ", ";\t"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_decimal_commas_are_read(tmp_path, separator, mark):
    """As spreadsheets write them in much of Europe, also with empty cells at the end."""
    rows = [separator.join(f"{value:.4f}".replace(".", ",") for value in row) for row in spectra()]
    (tmp_path / "chart.csv").write_text(mark + "\n".join(["nm", *(f"{row};" for row in rows)]), encoding="utf-8")
    np.testing.assert_allclose(read_spectra(tmp_path / "chart.csv"), spectra(), atol=1e-4)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda table: table[:, :20], "give a row a wavelength, nm and then 24 patches"),
        (lambda table: table[5:], "wavelengths must rise from 420 nm or less to 660 nm or more"),
        (lambda table: table[::-1], "wavelengths must rise"),
        (lambda table: table * np.r_[1, 100 * np.ones(24)], "divide those in per cent by 100"),
    ],
)
def test_other_tables_are_refused(tmp_path, change, reason):
    write_table(tmp_path / "chart.csv", change(spectra()))
    with pytest.raises(CalibrationError, match=reason):
        read_spectra(tmp_path / "chart.csv")


@pytest.mark.parametrize("text", ["", "nm;1;2\n400;0.1;0.2\n", "400,a,b\n"])
def test_what_is_no_table_is_refused(tmp_path, text):
    (tmp_path / "chart.csv").write_text(text)
    with pytest.raises(CalibrationError, match="is no table of spectra"):
        read_spectra(tmp_path / "chart.csv")
    with pytest.raises(CalibrationError, match="is no table of spectra"):
        read_spectra(tmp_path / "missing.csv")
