"""A station as a robot of other programs: observations out, rows in, under lease, limits and recording."""
