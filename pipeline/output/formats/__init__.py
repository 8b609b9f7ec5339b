"""The files that other programs open, one encoder each; `table` says which there are."""
