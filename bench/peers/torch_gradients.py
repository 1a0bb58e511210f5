"""Answers and gradients by the libraries of PyTorch that differentiate registration.

PyPose's ICP keeps every step and goes back through it. Theseus solves a pose graph and
differentiates it by the implicit function theorem, or through its steps.
"""

import importlib
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np


Answer = Callable[[np.ndarray], np.ndarray]


def pypose_icp(
    target: np.ndarray, T_target_source: np.ndarray, weights: np.ndarray
) -> tuple[Answer, Answer]:
    """From source points `(n, 3)`: the pose `(4, 4)`, and its weighted sum's slope.

    Point to point, from the pose that is given, until its own `Planner` stops it.
    """
    torch, pypose = map(_quietly, ("torch", "pypose"))
    torch.set_num_threads(1)
    fixed, start = map(torch.tensor, (target, T_target_source))
    init = pypose.mat2SE3(start, check=False)
    icp = pypose.module.ICP(stepper=pypose.utils.ReduceToBason(steps=200))

    def pose(source: Any) -> Any:
        return icp(source, fixed, init=init).matrix()

    return _answer_and_gradient(torch, pose, weights)


def theseus_graph(
    edges: np.ndarray, T_world_i: np.ndarray, weights: np.ndarray, backward_mode: str
) -> tuple[Answer, Answer]:
    """From motions `(e, 4, 4)`: poses `(v, 4, 4)`, and of their weighted sum the slope.

    Gauss-Newton from the poses that are given, dense Cholesky, the first pose held.
    """
    torch, theseus = map(_quietly, ("torch", "theseus"))
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    start = {f"x{i}": torch.tensor(T[None, :3]) for i, T in enumerate(T_world_i)}
    layer = _layer(theseus, torch, edges, start)
    last = torch.tensor([[[0.0, 0.0, 0.0, 1.0]]]).expand(len(start), 1, 4)

    def poses(T_i_j: Any) -> Any:
        seen = {f"z{k}": T_i_j[k : k + 1, :3] for k in range(len(edges))}
        mode = {"backward_mode": backward_mode}
        found, _ = layer.forward(start | seen, optimizer_kwargs=mode)
        return torch.cat([torch.cat([found[name] for name in start]), last], dim=1)

    return _answer_and_gradient(torch, poses, weights)


def _layer(theseus: Any, torch: Any, edges: np.ndarray, start: dict) -> Any:
    objective = theseus.Objective(dtype=torch.float64)
    world = [
        theseus.SE3(tensor=T, name=name, disable_checks=True)
        for name, T in start.items()
    ]
    alike = theseus.ScaleCostWeight(torch.ones(1, 1))
    for k, (i, j) in enumerate(edges):
        seen = theseus.SE3(name=f"z{k}")
        objective.add(theseus.Between(world[i], world[j], seen, alike, name=f"edge{k}"))
    held = theseus.SE3(tensor=start["x0"].clone(), name="held", disable_checks=True)
    firm = theseus.ScaleCostWeight(torch.full((1, 1), 1e3))
    objective.add(theseus.Difference(world[0], held, firm, name="first"))
    solver = theseus.GaussNewton(
        objective,
        linear_solver_cls=theseus.CholeskyDenseSolver,
        abs_err_tolerance=1e-12,
        rel_err_tolerance=1e-10,
    )
    return theseus.TheseusLayer(solver)


def _answer_and_gradient(
    torch: Any, solve: Callable[[Any], Any], weights: np.ndarray
) -> tuple[Answer, Answer]:
    loss = torch.tensor(weights)

    def answer(x: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return solve(torch.tensor(np.asarray(x))).numpy()

    def gradient(x: np.ndarray) -> np.ndarray:
        leaf = torch.tensor(np.asarray(x), requires_grad=True)
        (loss * solve(leaf)).sum().backward()
        return leaf.grad.numpy()

    return answer, gradient


def _quietly(name: str) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return importlib.import_module(name)
