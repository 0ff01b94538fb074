"""Validation of flowrec and the paper's figures. Its verb is found by name (`verbs/options.py`); no room imports it."""
