"""A program as one web page: what it is, episodes to step through, and why it does what it does."""

from sb3_progpolicy.pages.html import export_html

__all__ = ["export_html"]
