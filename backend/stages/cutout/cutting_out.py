"""The subject is cut out of photographs by a network, and what it cuts out is held against itself.

Cameras are placed before, by all that photographs show, for what surrounds a subject tells where they stood.
"""

from collections.abc import Sequence
from dataclasses import replace

from ...scene import CutOut, Decision, Mask, Progress, SolvedCameras, View, within
from ...wire.photographs import first_names
from .consensus import agreed
from .network import load_network, shown_subject

_FETCHED, _LOOKED_AT = 0.2, 0.95
"""How far the stage is when the network is there, and when it has seen all photographs."""
_REMEDY = "Masks of your own would tell what to keep."


def cut_out(solved: SolvedCameras, *, progress: Progress) -> CutOut:
    """A mask for each view that has none, as far as these agree with each other and with those given.

    Raises ReconstructionError(NETWORK_UNAVAILABLE).
    """
    views = solved.views
    bare = [index for index, view in enumerate(views) if view.mask is None]
    if not bare:
        decision = Decision(what="cut out", choice="nothing", because="every photograph has a mask already")
        return CutOut(masks=(None,) * len(views), decisions=(decision,))
    network = load_network(within(progress, 0.0, _FETCHED))
    masks = [view.mask for view in views]
    for number, index in enumerate(bare):
        done = _FETCHED + (_LOOKED_AT - _FETCHED) * number / len(bare)
        progress(done, f"cutting out photograph {number + 1} of {len(bare)}")
        masks[index] = shown_subject(network, views[index].image_srgb)
    del network
    progress(_LOOKED_AT, "holding them against each other")
    return _told(views, bare, agreed(masks, views, solved.sparse_positions))


def with_cut_out(solved: SolvedCameras, cut: CutOut) -> SolvedCameras:
    """The views with these masks, where they have none of their own."""
    pairs = zip(solved.views, cut.masks, strict=True)
    views = tuple(view if mask is None else replace(view, mask=mask) for view, mask in pairs)
    made = any(mask is not None for mask in cut.masks)
    return replace(solved, views=views, masks_cut_out=made, decisions=(*solved.decisions, *cut.decisions))


def _told(views: Sequence[View], bare: Sequence[int], masks: Sequence[Mask | None]) -> CutOut:
    """With a word about the photographs out of which nothing was cut."""
    without = [views[index].name for index in bare if masks[index] is None]
    doubt = None
    if len(without) == len(bare):
        doubt = (
            "The subject was not cut out: what stands out in one photograph is not what stands out in the "
            f"others. {_REMEDY}"
        )
    elif without:
        doubt = (
            f"The subject was not cut out of {first_names(without)}, for there it lacks what it has in the "
            f"others. {_REMEDY}"
        )
    decision = Decision(
        what="cut out",
        choice=f"the subject, in {len(bare) - len(without)} of {len(bare)} photographs",
        because="the network's cut-outs of these agree in space",
    )
    return CutOut(masks=tuple(masks), doubt=doubt, decisions=(decision,))
