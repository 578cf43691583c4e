"""The steps of the way through: push one record, take what it has to say."""
