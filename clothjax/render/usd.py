# OpenUSD has no stubs:
# pyright: reportAttributeAccessIssue=false
"""USD: an animated garment on its body, as meshes with a time sample for every frame."""

import importlib
from pathlib import Path

import numpy as np

from clothjax.render.performance import Performance
from clothjax.render.ray_cast import vertex_normals


def to_usd(path: str | Path, performance: Performance) -> None:
    """Write a .usdc, or a .usda that people can read: one Xform at the root, under it a mesh for each part.

    Raises:
        ImportError: if usd-core is not installed.
    """
    try:
        Gf, Usd, UsdGeom, Vt = (importlib.import_module(f"pxr.{name}") for name in ("Gf", "Usd", "UsdGeom", "Vt"))
    except ImportError as error:
        raise ImportError("USD needs usd-core: pip install clothjax[render]") from error
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(performance.fps)
    stage.SetFramesPerSecond(performance.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(performance.root) - 1)
    character = UsdGeom.Xform.Define(stage, "/character")
    stage.SetDefaultPrim(character.GetPrim())
    translation = character.AddTranslateOp()
    for t, place in enumerate(np.asarray(performance.root, np.float64)):
        translation.Set(Gf.Vec3d(*place), t)
    for part in performance.parts:
        mesh = UsdGeom.Mesh.Define(stage, f"/character/{part.name}")
        faces = np.asarray(part.faces, np.int32)
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1)))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(True)
        mesh.CreateDisplayColorAttr([Gf.Vec3f(*part.colour)])
        points, normals, extent = mesh.CreatePointsAttr(), mesh.CreateNormalsAttr(), mesh.CreateExtentAttr()
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        for t, vertices in enumerate(np.asarray(part.vertices, np.float32)):
            points.Set(Vt.Vec3fArray.FromNumpy(vertices), t)
            normals.Set(Vt.Vec3fArray.FromNumpy(vertex_normals(vertices, faces).astype(np.float32)), t)
            extent.Set([Gf.Vec3f(*map(float, vertices.min(axis=0))), Gf.Vec3f(*map(float, vertices.max(axis=0)))], t)
    stage.Export(str(path))
