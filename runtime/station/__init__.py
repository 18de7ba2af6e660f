"""Deployment of a station with its robot, checked before anything is connected."""
