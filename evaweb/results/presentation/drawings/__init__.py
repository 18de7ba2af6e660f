"""Figures of an evaluation as SVG, drawn on the server: the same on a page, on paper and in a report without a server.

Pure: numbers in, `svg.Drawing` out. Every figure has a title and a description that say the same in words. Series are
told apart by colour, dash and mark, and named beside what they are of; colours are those of the style sheet.
"""
