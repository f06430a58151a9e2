"""Names of viser's for annotations: it is imported when a page is opened, and not before."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from viser import IcosphereHandle as IcosphereHandle
    from viser import MeshHandle as MeshHandle
    from viser import SceneClickEvent as SceneClickEvent
    from viser import SceneNodeDragEvent as SceneNodeDragEvent
    from viser import SceneRectSelectEvent as SceneRectSelectEvent
    from viser import ViserServer as ViserServer

    Holdable = MeshHandle | IcosphereHandle
else:
    # What checks annotations while the program runs must find something.
    IcosphereHandle = MeshHandle = Holdable = ViserServer = Any
    SceneClickEvent = SceneNodeDragEvent = SceneRectSelectEvent = Any
