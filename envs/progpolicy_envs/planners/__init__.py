"""Planners: for every domain, how few steps its tasks need."""
