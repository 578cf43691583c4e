"""Conversion of records to and from messages, shared by recordings and nodes."""
