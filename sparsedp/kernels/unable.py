"""What is said where compiled kernels do not work."""

import warnings

__all__ = ["warn_unable"]


def warn_unable(error, level):
    """Say that compiled kernels do not work on this machine; `level` counts the callers above this one."""
    warnings.warn(f"The compiled kernels do not work here ({error}); NumPy is used instead.", RuntimeWarning, level)
