"""Render what a camera would see of a simulated scene, with its exact truth."""
