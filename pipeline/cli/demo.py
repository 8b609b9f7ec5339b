"""`colorphase demo`."""

from pathlib import Path

from rich.table import Table

from pipeline.cli.console import Arch, IntoOther, remark, say, stdout, steps


def demo(*, out: Path = Path("colorphase-demo"), arch: Arch = "auto", force: IntoOther = False) -> None:
    """Simulate one colour frame of a portrait, decode it, and measure the result against the truth.

    Example: colorphase demo --out demo

    Parameters
    ----------
    out
        Folder for the frame, the mesh, the pictures and the report.
    """
    from pipeline.batch.one_frame import decode_simulated

    with steps() as step:
        done = decode_simulated(out, arch, force=force, notify=step)
    _show(done.measured)
    for note in done.notes:
        remark(f"note: {note}")
    say(f"look at {done.picture}")


def _show(measured: dict[str, float | int]) -> None:
    table = Table(title="measured from one frame, against the truth", show_header=False)
    table.add_row("pixels measured (of those well lit)", f"{measured['coverage']:.1%}")
    table.add_row("phase error, RMS", f"{measured['phase_rms_rad']:.4f} rad")
    table.add_row("constant phase error", f"{measured['phase_constant_rad']:+.4f} rad")
    table.add_row("of these, fringe order known for certain", f"{measured['absolute'] / measured['coverage']:.1%}")
    table.add_row("depth error, RMS over all of them", f"{measured['depth_rms_mm']:.3f} mm")
    table.add_row("depth error, mean", f"{measured['depth_bias_mm']:+.3f} mm")
    table.add_row("99.9 % are off by less than", f"{measured['depth_p999_mm']:.3f} mm")
    stdout.print(table)
