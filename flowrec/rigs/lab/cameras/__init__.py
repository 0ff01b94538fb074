"""Cameras of a laboratory.

camera: what a driver does; one file per driver is a row of rig_settings.CAMERAS. grabber: a driver in a thread, behind
a queue. device_counts: the device's numbers and times of its images.
"""
