"""More than one process: blocks of each field on the ranks of mpirun, and ensembles of scenes on any executor."""
