"""The demo: estimate the conductivity of the ground from pressures measured at sensors. Read the files in this order.

scene.py     the physical model, the synthetic measurements and the loss; copy it for a problem of your own
story.py     run the problem on three grids: check the gradient, minimize, measure, print and write the results
terrain.py   load the field that serves as the true conductivity, and average it to any grid
"""
