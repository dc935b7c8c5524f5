"""Saved models with changed headers or tensors, under a hash that fits, as an attacker would write them."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable
from pathlib import Path

import safetensors
import safetensors.torch
from torch import Tensor

from forcegp.storage.model_file import HEADER, NO_HASH, model_path

Change = Callable[[dict, dict[str, Tensor]], object]


def header_of(source: Path) -> dict:
    """The header of a saved model."""
    with safetensors.safe_open(model_path(source), "pt") as file:
        return json.loads(file.metadata()[HEADER].partition("\n")[2])


def rewritten(source: Path, target: Path, change: Change) -> Path:
    """A copy of a saved model after a change of its header and tensors."""
    header, tensors = header_of(source), safetensors.torch.load_file(model_path(source))
    change(header, tensors)
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(50_000)
    text = json.dumps(header)
    sys.setrecursionlimit(limit)
    content = safetensors.torch.save(tensors, {HEADER: f"{NO_HASH}\n{text}"})
    digest = hashlib.sha256(content).hexdigest()
    content = content.replace(f'"{HEADER}":"{NO_HASH}'.encode(), f'"{HEADER}":"{digest}'.encode(), 1)
    model_path(target).write_bytes(content)
    return model_path(target)
