"""Messages that name causes, and the keys by which programs and tests know these."""

from typing import Literal, Self

#: Every cause that a message names; `tests/system/pipeline/test_causes.py` has frames and files with and without each.
Key = Literal[
    "another camera", "another sensor", "binned", "calibrated binned", "code not seen", "code shown", "code too weak",
    "colours swapped", "corners off", "cropped", "exposure_s", "field order shown", "fields unknown", "folded lens",
    "frames apart", "gain", "impossible period",
    "low contrast", "no fringe", "not calibrated", "odd colours", "on its side", "orders guessed", "other crosstalk",
    "other scene", "other shape", "other squares", "other stripes", "out of range", "over-exposed", "past the pattern",
    "poses do not fit", "repeated-chroma", "reversed", "reversed for another reason", "rig moved", "swapped",
    "too fast", "too fine", "transfer", "turned over", "under-exposed", "unusual period", "warped picture",
    "weak fringe", "white_balance",
]  # fmt: skip


class Cause(str):
    """A message that names a cause that was searched for, with a key by which programs and tests know the cause."""

    __slots__ = ("key",)
    key: Key

    def __new__(cls, key: Key, words: str) -> Self:
        """Return the words, with the key."""
        made = super().__new__(cls, words)
        made.key = key
        return made

    def __reduce__(self) -> tuple[type["Cause"], tuple[Key, str]]:
        """Keep the key: frames' warnings travel between processes."""
        return Cause, (self.key, str(self))
