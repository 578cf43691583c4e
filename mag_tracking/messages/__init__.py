"""Records to and from message-shaped dicts: declared once, used by recordings and nodes."""
