"""Deployment of a station with its robot, before anything is connected."""
