"""Devices of a laboratory: cameras, amplifiers, guardian."""
