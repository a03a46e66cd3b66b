"""The models that ship, with their cards."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, HTTPException, Path, Query

from server.cards import artifacts
from server.requests import NAME, Artifact, ModelList
from server.service import problems

router = APIRouter(prefix="/models", tags=["models"])


@router.get("", responses=problems())
def list_models() -> ModelList:
    """Every model at every scale that it has."""
    return ModelList(models=list(artifacts()))


@router.get("/{name}", responses=problems(404))
def read_model(name: Annotated[str, Path(pattern=NAME)], scale: Annotated[int, Query(ge=2, le=3)] = 2) -> Artifact:
    """One model at one scale."""
    for artifact in artifacts():
        if (artifact.name, artifact.scale) == (name, scale):
            return artifact
    raise HTTPException(404, f"there is no model {name} for scale {scale}")
