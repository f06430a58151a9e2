// Points and rays against capsules, and the fit that places the arm. Pure, without a scene.

import { Matrix4, Quaternion, Vector3 } from "three";

export type Triple = [number, number, number];
/** Unit quaternion (w, x, y, z), as in all messages. */
export type Quadruple = [number, number, number, number];

export const triple = (v: Vector3): Triple => [v.x, v.y, v.z];
export const quadruple = (q: Quaternion): Quadruple => [q.w, q.x, q.y, q.z];

/** Distance of a point from a segment. */
export function pointToSegment(point: Vector3, start: Vector3, end: Vector3): number {
  const along = end.clone().sub(start);
  const length = along.lengthSq();
  const t = length > 0 ? point.clone().sub(start).dot(along) / length : 0;
  return along.multiplyScalar(Math.min(Math.max(t, 0), 1)).add(start).distanceTo(point);
}

/**
 * Closest approach of a ray to a segment: distance along the ray, and distance between the two.
 * C. Ericson, Real-Time Collision Detection (2005), section 5.1.9, with one end left open.
 */
export function rayToSegment(
  origin: Vector3,
  direction: Vector3,
  start: Vector3,
  end: Vector3,
): { along: number; distance: number } {
  const d = end.clone().sub(start);
  const r = origin.clone().sub(start);
  const e = d.lengthSq();
  const b = direction.dot(d);
  const c = direction.dot(r);
  const f = d.dot(r);
  const parallel = e - b * b < 1e-12;
  let s = parallel ? 0 : Math.max((b * f - c * e) / (e - b * b), 0);
  let t = e > 0 ? (b * s + f) / e : 0;
  if (parallel || t < 0 || t > 1) {
    t = Math.min(Math.max(parallel ? 0 : t, 0), 1);
    s = Math.max(t * b - c, 0);
  }
  const near = origin.clone().addScaledVector(direction, s);
  return { along: s, distance: near.distanceTo(start.clone().addScaledVector(d, t)) };
}

/** Pose of the arm's base in the room, with a vertical axis. */
export interface Placement {
  /** Position of the base's origin, in the reference space of the session [m]. */
  position: Triple;
  /** Rotation about the vertical [rad]. */
  yaw: number;
  /** Size of the arm, as a fraction of its true size. */
  scale: number;
}

const UP = new Vector3(0, 1, 0);
// In the frames of arms, z points up; in those of WebXR, y points up.
const STAND = new Quaternion().setFromAxisAngle(new Vector3(1, 0, 0), -Math.PI / 2);

/** Transform from the base frame to the reference space. */
export function placementMatrix({ position, yaw, scale }: Placement): Matrix4 {
  const turn = new Quaternion().setFromAxisAngle(UP, yaw).multiply(STAND);
  const size = new Vector3(scale, scale, scale);
  return new Matrix4().compose(new Vector3(...position), turn, size);
}

/**
 * The upright placement that brings known points of the base frame nearest to touched ones.
 *
 * The headset measures gravity more accurately than fingertips, so only one angle and the
 * position are fitted, by least squares in closed form. `error` is the root mean square
 * residual [m].
 */
export function fitPlacement(
  known: Triple[],
  touched: Vector3[],
): { placement: Placement; error: number } {
  const stood = known.map((point) => new Vector3(...point).applyQuaternion(STAND));
  const mean = (points: Vector3[]) =>
    points.reduce((sum, p) => sum.add(p), new Vector3()).divideScalar(points.length);
  const [from, to] = [mean(stood), mean(touched)];
  let [sine, cosine] = [0, 0];
  stood.forEach((point, i) => {
    const k = point.clone().sub(from);
    const t = touched[i]!.clone().sub(to);
    sine += k.z * t.x - k.x * t.z;
    cosine += k.x * t.x + k.z * t.z;
  });
  const yaw = Math.atan2(sine, cosine);
  const position = to.clone().sub(from.clone().applyAxisAngle(UP, yaw));
  const placement = { position: triple(position), yaw, scale: 1 };
  const matrix = placementMatrix(placement);
  const squares = known.map((point, i) =>
    new Vector3(...point).applyMatrix4(matrix).distanceToSquared(touched[i]!),
  );
  return { placement, error: Math.sqrt(squares.reduce((a, b) => a + b) / squares.length) };
}

/** Angle about the vertical of an orientation in the reference space [rad]. */
export function yawOf(orientation: Quaternion): number {
  const x = new Vector3(1, 0, 0).applyQuaternion(orientation);
  return Math.atan2(-x.z, x.x);
}

/** A smaller rotation: the same axis, a fraction of the angle. */
export function partOf(turn: Quaternion, share: number): Quaternion {
  return new Quaternion().slerp(turn.w < 0 ? new Quaternion(-turn.x, -turn.y, -turn.z, -turn.w) : turn, share);
}
