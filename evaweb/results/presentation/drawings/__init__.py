"""Figures of an evaluation as SVG, drawn on the server: identical on pages, on paper and in offline reports.

Pure functions from numbers to `svg.Drawing`. Every figure has a title and a description with the same content as text.
Series differ in colour, dash and mark, and are named in the figure; colours come from the style sheet.
"""
