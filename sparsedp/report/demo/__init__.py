"""The demo: find the hidden ground from well readings. Read in this order.

files.py     a file from anywhere -> a plain 2-D array, or one sentence that says why not
terrain.py   the field that plays the hidden ground, on any grid
scene.py     the physics: wells, readings, the loss. The part to copy for a problem of your own
study.py     the same scene on three grids: check the gradient, recover, count, time
story.py     what the reader sees, and the files that are left behind
"""
