"""Many sessions: sweep, push, catalog, find. Its verbs are found by name (`verbs/options.py`); no room imports it."""
