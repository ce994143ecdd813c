"""The demo: find the hidden ground from well readings. Read in this order.

scene.py     the physics: wells, readings, the loss. The part to copy for a problem of your own
story.py     the same scene on three grids: check the gradient, recover, count, time; what is printed and written
terrain.py   the field that serves as the hidden ground: a plain 2-D array from any file, on any grid
"""
