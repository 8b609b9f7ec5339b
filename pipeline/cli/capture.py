"""`colorphase capture`."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipeline.acquisition import session
from pipeline.acquisition.capture_folder import CALIBRATION, SETTINGS, CapturePlan, CaptureProgress
from pipeline.acquisition.chosen_rig import choose_rig
from pipeline.acquisition.session import CaptureSummary, Stopping
from pipeline.cli.console import Arch, PageOptions, SettingsFile, above_zero, read_settings, remark, say, stderr, steps
from pipeline.errors import SettingsError
from pipeline.footage.frame_times import LOG

if TYPE_CHECKING:
    from pipeline.view.live_subject import LiveSubject

#: Exit code where it was stopped before all bursts were there.
_STOPPED = 130
_ANYWHERE = PageOptions()


def capture(
    *,
    rig: str,
    out: Path,
    bursts: Annotated[int | None, Parameter(validator=above_zero)] = None,
    endless: bool = False,
    keep_last: Annotated[float | None, Parameter(validator=above_zero)] = None,
    view: bool = False,
    settings: SettingsFile = None,
    arch: Arch = "auto",
    at: PageOptions = _ANYWHERE,
) -> None:
    """Fire projector and camera, and record every frame with the pulse that it belongs to.

    A burst is kept whole, or thrown away and fired again, three times at most. The folder gets the recording, log.jsonl
    and the rig's calibration.json.

    Example: colorphase capture --rig rig.toml --out face --bursts 10, or
    colorphase capture --rig simulated --out captured --endless --view

    Parameters
    ----------
    rig
        The rig's TOML file; or "simulated", which needs nothing to be there.
    out
        The folder to make.
    bursts
        Number of bursts; left out, one, or with --endless or --keep-last as many as come until Ctrl-C.
    endless
        Let pulses run on without a gap, until Ctrl-C.
    keep_last
        Keep frames in memory until Ctrl-C, and record only this many seconds before it.
    view
        Decode the newest frame meanwhile, and show it in the browser.
    """
    if not view and settings is not None:
        raise SettingsError(f"{settings} is for --view: add --view, or omit --settings")
    if not view and at != _ANYWHERE:
        raise SettingsError("--port and --no-browser are for --view: add --view, or omit them")
    plan = CapturePlan(
        n_bursts=1 if bursts is None and not endless and keep_last is None else bursts,
        endless=endless,
        keep_last_s=keep_last,
        live=view,
        arch=arch,
    )
    stopping = Stopping()
    with stopping.listening():  # until the last line is printed
        with steps() as show:
            chosen = choose_rig(rig, arch, show)
            stopping.check()
            for note in chosen.differences():
                remark(f"note: {note}")
            show("opening trigger source and camera")
            page = _page(out.name, at) if view else nullcontext()
            with chosen.showing_pattern() as keep, page as subject:

                def notify(progress: CaptureProgress) -> None:
                    show(_line(progress))
                    if subject is not None and progress.watched is not None:
                        subject.hear(progress.watched, progress.n_rejected)
                    keep()

                summary = session.capture_bursts(
                    chosen.settings,
                    chosen.open_instruments,
                    out,
                    plan,
                    calibration=chosen.calibration,
                    decoding=read_settings(settings),
                    stopping=stopping,
                    notify=notify,
                )
        _say_summary(summary, out, calibrated=chosen.calibration is not None)
        if not summary.n_frames or (summary.stopped and bursts is not None):
            sys.exit(_STOPPED)


@contextmanager
def _page(title: str, at: PageOptions) -> Iterator["LiveSubject"]:
    """Serve a page of the capture meanwhile."""
    from pipeline.cli.view import served  # other captures do without
    from pipeline.view.live_subject import LiveSubject

    subject = LiveSubject(title)
    with served(subject, at):
        yield subject


def _say_summary(summary: CaptureSummary, out: Path, *, calibrated: bool) -> None:
    for note in summary.notes:
        remark(f"note: {note}")
    if not summary.n_frames:
        stderr.print("stopped before a burst was whole: nothing is kept", style="red")
        return
    if summary.n_rejected:
        remark(f"{_times(summary.n_rejected)} a burst was thrown away; {out / LOG} says why")
    say(f"recorded {_frames(summary)} in {summary.recording}; each frame's pulse is in {out / LOG}")
    rig_file = f" --calibration {out / CALIBRATION}" if calibrated else ""
    settings = f" --settings {out / SETTINGS}" if (out / SETTINGS).exists() else ""
    say(f"colorphase decode {summary.recording} --out {out / 'decoded'}{rig_file}{settings}")


def _times(n: int) -> str:
    return {1: "once", 2: "twice"}.get(n, f"{n} times")


def _frames(counted: CaptureProgress | CaptureSummary) -> str:
    counts = ((counted.n_frames, "frame"), (counted.n_bursts, "burst"))
    return " of ".join(f"{n} {word}{'' if n == 1 else 's'}" for n, word in counts)


def _line(progress: CaptureProgress) -> str:
    parts = [_frames(progress), f"{progress.rate_hz:.0f} frames/s"]
    if progress.latency_s is not None:
        parts.append(f"{1e3 * progress.latency_s:.0f} ms from strobe to range image")
    if progress.n_rejected:
        parts.append(f"{_times(progress.n_rejected)} a burst was thrown away ({progress.note})")
    return ", ".join(parts)
