"""Fields with their grid in files and in xarray, and pictures as fields.

archive.py     save, load: which file holds what, .npz
contents.py    what may be saved, and where a field lives
labelled.py    to_xarray, from_xarray; .nc and .zarr
paraview.py    .vti, .vtr, .pvd
pictures.py    from_image
"""
