"""Recomputes every number of a report from its data alone: `python3 -m recompute` in the report's folder.

Written independently of the lab's statistics, with Python's standard library only, so that an error there is not
repeated here. Random draws are repeated, and compared within the tolerance of a new draw.
"""
