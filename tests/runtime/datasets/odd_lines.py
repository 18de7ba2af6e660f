"""Characters that str.splitlines takes for ends of lines, and JSON Lines does not."""

ENDS_NO_LINE = ("\u2028", "\u2029", "\x85", "\x0b", "\x0c", "\x1c", "\x1d", "\x1e")
