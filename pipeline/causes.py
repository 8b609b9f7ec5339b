"""Messages that name causes, and the keys by which programs and tests know these."""

from typing import Self


class Cause(str):
    """A message that names a cause that was looked for, with a key by which programs and tests know the cause."""

    __slots__ = ("key",)
    key: str

    def __new__(cls, key: str, words: str) -> Self:
        """Return the words, with the key."""
        made = super().__new__(cls, words)
        made.key = key
        return made

    def __reduce__(self) -> tuple[type["Cause"], tuple[str, str]]:
        """Keep the key: frames' warnings travel between processes."""
        return Cause, (self.key, str(self))
