"""Fields with their grid in files and in xarray, and pictures as fields.

archive.py      save, load: which file holds what, .npz
file_format.py  what may be saved, and where a field lives
labelled.py     to_xarray, from_xarray; .nc and .zarr
paraview.py     .vti, .vtr, .pvd
pictures.py     from_image
"""
