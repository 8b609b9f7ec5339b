"""What a newcomer has: the command line."""

from support.command_in_process import command

__all__ = ["command"]
