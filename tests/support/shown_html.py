"""What a reader of a notebook sees of a block of HTML."""

import base64
from html.parser import HTMLParser

import cv2
import numpy as np
import numpy.typing as npt


class Shown(HTMLParser):
    """A block of HTML, read: its table, its list of warnings, and its pictures."""

    def __init__(self, block: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.texts: list[str] = []
        self.pictures: list[bytes] = []
        self.warnings: list[str] = []
        self._open: list[str] = []
        self._cells: list[str] = []
        self.feed(block)
        self.close()
        assert self._open == [], f"never closed: {self._open}"

    @property
    def figures(self) -> dict[str, str]:
        """The table's rows."""
        return dict(zip(self._cells[::2], self._cells[1::2], strict=True))

    @property
    def picture(self) -> npt.NDArray[np.uint8]:
        """The only picture, (H, W, 3)."""
        (data,) = self.pictures
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return np.asarray(image, np.uint8)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note a tag, and a picture's bytes."""
        self.tags.add(tag)
        if tag == "img":
            source = dict(attrs)["src"] or ""
            self.pictures.append(base64.b64decode(source.removeprefix("data:image/png;base64,"), validate=True))
            return
        self._open.append(tag)
        if tag in ("th", "td"):
            self._cells.append("")
        if tag == "li":
            self.warnings.append("")

    def handle_endtag(self, tag: str) -> None:
        """Check that what ends is what was opened last."""
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Note a text where it stands."""
        self.texts.append(data)
        if self._open[-1] in ("th", "td"):
            self._cells[-1] += data
        if self._open[-1] == "li":
            self.warnings[-1] += data
