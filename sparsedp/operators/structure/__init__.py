"""How a linear map acts on flat plain arrays: no fields, no tape, no names."""
