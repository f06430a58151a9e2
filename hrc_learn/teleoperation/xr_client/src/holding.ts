// Actions of hands: hold a link or the end effector of either arm, guide the end effector from
// a distance, draw the region, mark the target, touch the points that place the arm.

import { Matrix4, Plane, Vector3 } from "three";
import { CORNERS, type ArmView, type Met } from "./arm_view";
import { partOf, quadruple, triple, type Triple } from "./geometry";
import type { Pointer } from "./inputs";
import { within, type Grip, type HandName, type Region } from "./protocol";

/** An action that lasts from a pinch until it opens. */
export interface Drag {
  move(pointer: Pointer): void;
  end(): void;
}

/** Handles a pinch, or leaves it to the next tool. */
export interface Tool {
  begin(pointer: Pointer): Drag | null;
}

/** Distance within which a hand holds a body, at the scale shown to the person [m]: a finger's
 * breadth and the error of hand tracking. */
const NEAR = 0.05;
/** Distance within which a ray meets a body [m]: half the breadth of a finger. */
const SLACK = 0.01;

export interface Settings {
  /** Motion of the end effector per motion of a hand that guides it from a distance. */
  gain: number;
  /** True if the hand that guides the end effector adds its rotation to the coarse rule. */
  turns: boolean;
}

/** What a pinch would hold now. */
export interface Target {
  view: ArmView;
  met: Met | null;
  how: "near" | "ray" | "clutch";
}

/** Holds links and the end effector. */
export class Holding implements Tool {
  readonly grips = new Map<HandName, Grip>();
  readonly targets = new Map<HandName, Target>();

  /**
   * @param views Views of the arm; the view over the real arm is the first.
   * @param tool Position of the end effector, in the base frame; null before it is known.
   * @param forward Direction of the camera, for fingers on a screen.
   */
  constructor(
    private views: () => ArmView[],
    private tool: () => Triple | null,
    private guides: boolean,
    private settings: Settings,
    private forward: () => Vector3,
  ) {}

  /** What a pinch would hold now; null: nothing. */
  target(pointer: Pointer): Target | null {
    const views = this.views();
    const { position, ray } = pointer;
    const best = (meet: (view: ArmView) => Met | null, how: "near" | "ray", most: number) =>
      views
        .map((view): Target => ({ view, met: meet(view), how }))
        .filter(({ met }) => met && met.distance <= most)
        .sort((a, b) => a.met!.distance - b.met!.distance)[0];
    const found =
      (position && best((view) => view.nearest(position), "near", NEAR)) ??
      best((view) => view.along(ray.origin, ray.direction, SLACK), "ray", 5);
    if (found) return found;
    const arm = views[0];
    return position && this.guides && arm ? { view: arm, met: null, how: "clutch" } : null;
  }

  begin(pointer: Pointer): Drag | null {
    const target = this.target(pointer);
    const tool = this.tool();
    if (!target || !tool) return null;
    const { view, met, how } = target;
    const joint = met ? met.joint : null;
    let start: Triple;
    let follow: (pointer: Pointer) => Vector3;
    if (how === "near") {
      start = triple(view.toBase(pointer.position!));
      follow = ({ position }) => view.toBase(position!);
    } else if (how === "clutch") {
      const from = view.toBase(pointer.position!);
      start = tool;
      const { gain } = this.settings;
      follow = ({ position }) =>
        view.toBase(position!).sub(from).multiplyScalar(gain).add(new Vector3(...start));
    } else {
      const hit = pointer.ray.at(met!.distance, new Vector3());
      start = triple(view.toBase(hit));
      const carry = pointer.position ? this.rod(pointer, hit) : this.pane(hit);
      follow = (now) => view.toBase(carry(now));
    }
    const turned = pointer.orientation.clone();
    const turns = joint === null && this.settings.turns && pointer.position !== null;
    const share = how === "clutch" ? Math.min(this.settings.gain, 1) : 1;
    const move = (now: Pointer) => {
      const aimed = triple(follow(now));
      if (!within(aimed)) return; // beyond this range, the gate refuses the message
      const turn = now.orientation.clone().multiply(turned.clone().invert());
      this.grips.set(pointer.hand, {
        hand: pointer.hand,
        joint,
        start,
        pointer: aimed,
        orientation: turns ? quadruple(partOf(view.turnToBase(turn), share)) : null,
      });
    };
    this.targets.set(pointer.hand, target);
    return {
      move,
      end: () => {
        this.grips.delete(pointer.hand);
        this.targets.delete(pointer.hand);
      },
    };
  }

  /** From a distance, the held body moves with the ray as if fixed to a rod. */
  private rod(pointer: Pointer, hit: Vector3): (now: Pointer) => Vector3 {
    const held = hit.clone().applyMatrix4(new Matrix4().copy(pointer.aim).invert());
    return ({ aim }) => held.clone().applyMatrix4(aim);
  }

  /** On a screen, the held body moves in the plane that faces the camera. */
  private pane(hit: Vector3): (now: Pointer) => Vector3 {
    const plane = new Plane().setFromNormalAndCoplanarPoint(this.forward(), hit);
    let last = hit.clone();
    return ({ ray }) => {
      last = ray.intersectPlane(plane, new Vector3()) ?? last;
      return last.clone();
    };
  }
}

/** Half sizes that a region may have [m], as on the page. */
const SMALLEST = 0.02;
const LARGEST = 0.5;
/** Distance from a corner within which a pinch resizes the region [m]. */
const CORNER = 0.04;
/** Height of a region drawn on a screen, where a finger has no depth [m]. */
const HEIGHT = 0.2;

/** The box between two corners, along the base axes. */
export function boxBetween(a: Vector3, b: Vector3): Region {
  const half = b.clone().sub(a).divideScalar(2);
  const size = (x: number) => Math.min(Math.max(Math.abs(x), SMALLEST), LARGEST);
  return {
    centre: triple(a.clone().add(b).divideScalar(2)),
    half_size: [size(half.x), size(half.y), size(half.z)],
  };
}

/** Resizes the region near a corner, moves it inside, and draws a new region elsewhere. */
export class Drawing implements Tool {
  /** Region that is being drawn; null: no region is being drawn. */
  region: Region | null = null;

  constructor(
    private views: () => ArmView[],
    private drawn: () => Region | null,
    private send: (region: Region) => void,
  ) {}

  begin(pointer: Pointer): Drag | null {
    const view = nearestView(this.views(), pointer);
    const at = (now: Pointer) => this.point(now, view);
    const start = view && at(pointer);
    if (!view || !start) return null;
    const reshape = this.change(start, view.scale, pointer.position === null);
    let last = this.drawn();
    return {
      move: (now) => {
        const point = at(now);
        if (!point) return;
        const region = reshape(point);
        if (JSON.stringify(region) === JSON.stringify(last)) return;
        last = this.region = region;
        this.send(region);
      },
      end: () => (this.region = null),
    };
  }

  private point(pointer: Pointer, view: ArmView | undefined): Vector3 | null {
    if (!view) return null;
    if (pointer.position) return view.toBase(pointer.position);
    // On a screen, the point of the table under the pointer.
    const up = new Vector3(0, 0, 1).transformDirection(view.group.matrixWorld);
    const table = new Plane().setFromNormalAndCoplanarPoint(up, view.toWorld([0, 0, 0]));
    const hit = pointer.ray.intersectPlane(table, new Vector3());
    return hit && view.toBase(hit);
  }

  private change(start: Vector3, scale: number, flat: boolean): (point: Vector3) => Region {
    const before = this.drawn();
    if (before && !flat) {
      const centre = new Vector3(...before.centre);
      const half = new Vector3(...before.half_size);
      for (const signs of CORNERS) {
        const reach = half.clone().multiply(new Vector3(...signs));
        const corner = centre.clone().add(reach);
        const offset = corner.clone().sub(start);
        if (offset.length() * scale > CORNER) continue;
        const opposite = centre.clone().sub(reach);
        return (point) => boxBetween(opposite, point.clone().add(offset));
      }
      const inside = start.clone().sub(centre).divide(half).toArray().every((x) => Math.abs(x) < 1);
      if (inside) {
        return (point) => ({
          centre: triple(point.clone().sub(start).add(centre)),
          half_size: before.half_size,
        });
      }
    }
    if (flat) return (point) => boxBetween(start, point.clone().setZ(HEIGHT));
    return (point) => boxBetween(start, point);
  }
}

/** Marks the target where a hand pinches. */
export class Marking implements Tool {
  constructor(
    private views: () => ArmView[],
    private send: (point: Triple) => void,
  ) {}

  begin(pointer: Pointer): Drag | null {
    const view = nearestView(this.views(), pointer);
    if (!view || !pointer.position) return null;
    const mark = ({ position }: Pointer) => {
      const point = triple(view.toBase(position!));
      if (within(point)) this.send(point);
    };
    mark(pointer);
    return { move: mark, end: () => {} };
  }
}

/** Collects the points that place the arm over the real one. */
export class Touching implements Tool {
  private touched: Vector3[] = [];

  constructor(
    private count: number,
    private done: (touched: Vector3[]) => void,
  ) {}

  /** Number of points touched so far. */
  get so_far(): number {
    return this.touched.length;
  }

  begin(pointer: Pointer): Drag | null {
    // A fingertip locates a point most accurately; a controller has none.
    const point = pointer.position;
    if (!point) return null;
    this.touched.push(point.clone());
    if (this.touched.length === this.count) {
      this.done(this.touched);
      this.touched = [];
    }
    return { move: () => {}, end: () => {} };
  }
}

/** Moves the twin, held at its base, to another place. */
export class MovingTwin implements Tool {
  constructor(
    private twin: () => ArmView | null,
    private stand: (position: Vector3) => void,
  ) {}

  begin(pointer: Pointer): Drag | null {
    const twin = this.twin();
    if (!twin || !pointer.position) return null;
    const foot = twin.toWorld([0, 0, 0]);
    const offset = foot.clone().sub(pointer.position);
    if (offset.length() > NEAR) return null;
    return { move: ({ position }) => this.stand(position!.clone().add(offset)), end: () => {} };
  }
}

/** The nearer of two arms to a hand, with the distances at the scale of each arm. */
function nearestView(views: ArmView[], pointer: Pointer): ArmView | undefined {
  const { position } = pointer;
  if (!position) return views[0];
  const distance = (view: ArmView) => view.toBase(position).length();
  return [...views].sort((a, b) => distance(a) - distance(b))[0];
}

