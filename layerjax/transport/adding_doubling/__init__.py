"""A stack on a grid of directions: the pieces that `AddingDoubling` is made of."""
