"""Maps of materials: measurements of every texel go in, by blocks; a store with the parameters of each comes out."""
