"""Side room: pictures, and the demo. It may import every floor; only __main__ and the shop window open it."""
