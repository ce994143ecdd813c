"""Save and load fields with their grid, convert them to xarray, and read images as fields.

archive.py        save, load: choose the format by the suffix of the file name
atomic_files.py   write files atomically; trees in .npz files
file_format.py    check fields, and find the space of each field
labelled.py       to_xarray, from_xarray; .nc and .zarr files
paraview.py       .vti, .vtr and .pvd files
pictures.py       from_image
"""
