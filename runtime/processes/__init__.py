"""The processes of a station, which do not know each other; nothing below imports them."""
