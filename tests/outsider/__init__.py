"""Worked packages of others, each a file: what a lab writes to use its own devices and laws."""
