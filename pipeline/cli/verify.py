"""`colorphase verify`: check that stored frames are complete."""

import sys

from pipeline.cli.console import SOME_ARE_BAD, counted, frames, remark, say
from pipeline.verification import verify as verify_all

_SHOWN = 10  # frames that are named


def verify(input: str, /) -> None:
    """Read all of a result or recording, and report which frames are complete.

    A capture whose program was killed is finished: what was complete is kept under its name. Decoding again, with the
    same options, repairs a result. Exit code 3: something is damaged.

    Example: colorphase verify film/result.zarr, or colorphase verify capture

    Parameters
    ----------
    input
        The result.zarr, a folder or an fsspec URL; a recording; or a folder that holds them.
    """
    with counted("verifying") as show:
        found = verify_all(input, show)
    for each in found:
        for note in each.notes:
            remark(f"note: {note}")
        for number, fault in list(each.faults.items())[:_SHOWN]:
            remark(f"frame {number}: {fault}")
        if len(each.faults) > _SHOWN:
            remark(f"and {frames(len(each.faults) - _SHOWN)} damaged, too")
        for line in each.damage:
            remark(line)
        damaged = f", {len(each.faults)} damaged" if each.faults else ""
        if each.n_whole or damaged or not each.notes:
            say(f"{each.name}: {frames(each.n_whole)} whole{damaged}")
    if not all(each.whole for each in found):
        sys.exit(SOME_ARE_BAD)
