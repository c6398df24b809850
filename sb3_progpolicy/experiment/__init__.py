"""Experiments: the registry of methods, checked configurations, run folders, and training that can be resumed."""
