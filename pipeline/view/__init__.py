"""The viewer: a page that is served on loopback, or that contains its frames."""
