"""Files with bytes changed, cut off, put in or swapped."""

import numpy as np


def mutated(raw: bytes, random: np.random.Generator, head: int = 400) -> bytes:
    """One of many. head: how far what comes first reaches, of which half the changes are."""
    changed = bytearray(raw)
    reach = len(raw) if random.random() < 0.5 else min(head, len(raw))
    kind = random.integers(5)
    if kind == 0:
        for _ in range(random.integers(1, 20)):
            changed[random.integers(reach)] = random.integers(256)
    elif kind == 1:
        del changed[random.integers(reach) :]
    elif kind == 2:
        place = random.integers(reach)
        changed[place:place] = random.bytes(random.integers(1, 50))
    elif kind == 3:
        start, length = random.integers(reach), random.integers(1, 50)
        del changed[start : start + length]
    else:  # digits for digits, as of a file that was edited by hand
        digits = [place for place in range(reach) if chr(changed[place]).isdigit()]
        for place in random.choice(digits, min(len(digits), 5)) if digits else ():
            changed[place] = ord(random.choice(list("0123456789-.eE ")))
    return bytes(changed)
