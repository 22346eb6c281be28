"""Which stack is behind data: libraries of layers and bases, the search through what they make, and what it found."""
