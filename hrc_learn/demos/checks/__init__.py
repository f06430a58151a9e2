"""What can be wrong with a dataset, one kind of fault a module."""
