"""Taichi kernels and their host functions: arrays in, arrays out."""
