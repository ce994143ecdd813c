"""Utilities without physics: argument validation, pytrees, counters, buffers, HTML, progress."""
