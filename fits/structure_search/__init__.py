"""Which stack is behind data: libraries of layers and bases, and the search through the stacks that they make."""
