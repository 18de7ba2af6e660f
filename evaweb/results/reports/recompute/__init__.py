"""Computes every number of a report again, from its data alone: `python3 -m recompute` in the report's folder.

Written apart from the lab's own statistics, with nothing but Python's standard library, so that an error there is not
repeated here. What was drawn is drawn anew, and held against what drawing anew may differ by.
"""
