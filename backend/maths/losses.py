"""What a field is asked to satisfy; each loss is a mean over its first axis, in squared or absolute cells.

Names: f is the field, q a query, p a measured point with unit normal n. The two Taylor residuals are
SparseCraft's (Younes et al., ECCV 2024, in the scalar form of its project page), which, unlike the
distance to the nearest point, are 0 wherever q lies on the measured tangent plane.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import softplus


def taylor_at_query(
    distance: Float[Tensor, "points"],
    gradient: Float[Tensor, "points 3"],
    p_minus_q: Float[Tensor, "points 3"],
) -> Float[Tensor, "points"]:
    """f(q) + grad f(q) . (p - q): the field at p as q foresees it, 0 if p is on the surface."""
    return distance + (gradient * p_minus_q).sum(dim=-1)


def taylor_at_point(
    distance: Float[Tensor, "points"], normal: Float[Tensor, "points 3"], p_minus_q: Float[Tensor, "points 3"]
) -> Float[Tensor, "points"]:
    """f(q) - n . (q - p): how far the field at q is from what the point's plane foretells."""
    return distance + (normal * p_minus_q).sum(dim=-1)


def charbonnier(residual: Float[Tensor, "*batch"], scale: float) -> Float[Tensor, "*batch"]:
    """Quadratic below `scale`, then as the absolute value: outliers pull, but no harder than others.

    scale (sqrt(1 + x^2) - 1) with x = residual / scale, without the difference, which is 0 for small x.
    """
    scaled = residual / scale
    return residual * scaled / (torch.sqrt(1 + scaled * scaled) + 1)


def length(gradient: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
    """|grad f|; where the gradient vanishes, the derivative is taken to be 0."""
    norm: Tensor = torch.linalg.vector_norm(gradient, dim=-1)
    return norm


def eikonal(gradient: Float[Tensor, "points 3"]) -> Float[Tensor, ""]:
    """Mean of (|grad f| - 1)^2."""
    return (length(gradient) - 1).square().mean()


def silhouette(log_pass: Float[Tensor, "rays"], coverage: Float[Tensor, "rays"]) -> Float[Tensor, ""]:
    """Cross-entropy between a ray's opacity and the mask, from the log of the ray's transparency.

    With t = log transparency <= 0: -(1 - m) t - m log(1 - e^t). The second log is bounded by letting every
    ray lose a thousandth of its light, far below what a mask can tell.
    """
    leak = 1e-3
    opacity = -torch.expm1(log_pass) * (1 - leak) + leak
    return (-(1 - coverage) * log_pass - coverage * torch.log(opacity)).mean()


def entropy_of_side(distance: Float[Tensor, "points"], sharpness: float) -> Float[Tensor, "points"]:
    """Entropy of being inside or outside, in nats; log 2 on the surface, 0 far from it.

    H(Phi(s f)) after SparseOcc (Ouasfi and Boukhayma, CVPR 2024), from logits: no log of 0. It is the same on
    both sides; of the absolute logit both terms are positive, and nothing cancels.
    """
    logit = sharpness * distance.abs()
    return softplus(-logit) + logit * torch.sigmoid(-logit)
