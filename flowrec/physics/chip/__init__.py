"""The chip: where fluid is, where it enters and leaves, how far the walls are."""
