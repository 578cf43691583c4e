"""Reading, writing, repair and import of recordings and other data files."""
