"""Which whole cycles every region of a frame has: by the code, the frame before, or the expected depth."""

from pipeline.orders.order_finder import OrderFinder

__all__ = ["OrderFinder"]
