"""The progress bar of a rollout: asks for tqdm only when a bar is wanted."""

__all__ = ["shown_steps"]


def shown_steps(wanted, steps, label):
    """Step numbers -> the same, with a bar on standard error when one is wanted (True, or its label).

    Raises
    ------
    ImportError
        If a bar is wanted and tqdm is not installed.
    """
    if not wanted:
        return steps
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError("a progress bar needs tqdm; install sparsedp[plot], or leave progress out") from error
    return tqdm(steps, desc=f"{wanted} {label}" if isinstance(wanted, str) else label, leave=False)
