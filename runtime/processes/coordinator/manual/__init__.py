"""Joints, grippers and poses that a person gives."""
