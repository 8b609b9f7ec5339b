"""What a user does with the kernels: decode, export, render, simulate."""
