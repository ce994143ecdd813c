"""More than one process: ensembles of scenes on any executor."""
