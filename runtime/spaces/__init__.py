"""Joints, poses, formats and frames, as mathematics on arrays."""
