"""Preflights of checkpoints: queries of their policy servers without a robot, and the reports."""
