"""Calls that must be refused."""

from collections.abc import Callable
from typing import Any

import pytest


def refuses(
    words: str, call: Callable[..., Any], *given: Any, error: type | tuple[type, ...] = ValueError, **options: Any
) -> str:
    """The message of the error with which this call must end, and in which these words must be found."""
    with pytest.raises(error, match=words) as caught:
        call(*given, **options)
    return str(caught.value)
