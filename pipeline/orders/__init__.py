"""The whole cycles of every region of a frame: by the code, the frame before, or the expected depth."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from pipeline.orders.order_finder import OrderFinder

__all__ = ["OrderFinder"]
__getattr__, __dir__ = lazily(__name__)
