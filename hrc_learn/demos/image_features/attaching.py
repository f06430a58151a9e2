"""Features that were extracted from videos, put into demonstrations."""

from dataclasses import replace
from pathlib import Path

from ..demonstration import Demonstration
from ..demonstration_set import DemonstrationSet
from ..finding import DatasetError
from .cache import FeatureCache, feature_names


def attach_features(demos: DemonstrationSet, name: str | None = None) -> DemonstrationSet:
    """Demonstrations with a feature that `extract_features` found in their videos.

    `load_demos` and `open_demos` do so by themselves where a dataset has no image feature of
    its own and exactly one was extracted.

    Args:
        demos: Read from a dataset.
        name: Name of the feature, such as "front.marker_3"; None: the only one.

    Raises:
        DatasetError: There is no such feature, or it was not extracted from all episodes.
    """
    root = Path(demos.source)
    known = feature_names(root) if demos.source else []
    chosen = [feature for feature in known if name in (None, feature)]
    if len(chosen) != 1:
        raise DatasetError(
            f"{'say which feature' if name is None else f'there is no feature {name!r}'}; "
            f"extracted are {', '.join(known) or 'none'}",
            file=demos.source,
        )
    cache = FeatureCache(root, chosen[0])
    return demos.map(lambda demo: with_feature(demo, cache))


def only_feature(root: Path) -> FeatureCache | None:
    """The feature that was extracted from a dataset; None where that is not exactly one."""
    names = feature_names(root)
    return FeatureCache(root, names[0]) if len(names) == 1 else None


def with_feature(demo: Demonstration, cache: FeatureCache) -> Demonstration:
    """The demonstration with the feature of its episode.

    Raises:
        DatasetError: It was not extracted from this episode.
    """
    track = cache.read(demo.episode, len(demo))
    return replace(demo, feature=track.pixels, feature_visible=track.visible)
