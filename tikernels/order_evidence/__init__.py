"""What a frame shows of the absolute fringe orders: the contrast of each cycle, and the votes of the frame before."""
