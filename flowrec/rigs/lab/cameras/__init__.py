"""Cameras of a laboratory.

camera: what a driver does. One file per driver: a row of rig_settings.CAMERAS.
"""
