// The arm and its workplace, drawn from the glTF file of the server: over the real arm, as a
// small twin, or as the ghost of a demonstration.

import {
  BoxGeometry,
  BufferGeometry,
  Color,
  ConeGeometry,
  CylinderGeometry,
  EdgesGeometry,
  Group,
  Line,
  LineBasicMaterial,
  LineSegments,
  Material,
  Mesh,
  MeshBasicMaterial,
  MeshStandardMaterial,
  Object3D,
  Quaternion,
  SphereGeometry,
  Vector3,
} from "three";
import { pointToSegment, rayToSegment, type Triple } from "./geometry";
import type { Description, Region, SceneState } from "./protocol";

/** A body that a hand or a ray has met. */
export interface Met {
  joint: number | null;
  /** Index of the body. */
  body: number;
  /** Distance between hand and surface, or along the ray, at the scale shown to the person [m]. */
  distance: number;
}

export interface Look {
  /** As in the paper: an arm within reach is held directly, a remote arm from a distance. */
  manipulation: "close" | "remote" | "ghost";
  /** True if the whole workplace is drawn, false if only the arm is. */
  furniture: boolean;
  opacity: number;
  tint?: string;
}

const GREEN = "#009E73";
const ORANGE = "#E69F00";
const UP = new Vector3(0, 1, 0);

export class ArmView {
  /** Its frame is the arm's base frame. */
  readonly group = new Group();
  readonly manipulation: Look["manipulation"];
  private frames: (Group | null)[];
  private region = new RegionBox(GREEN);
  private followed = new RegionBox(GREEN);
  private arrows = new Arrows();
  private plan = new Line(new BufferGeometry(), new LineBasicMaterial({ color: ORANGE }));
  private highlighted = -1;

  constructor(
    model: Object3D,
    private description: Description,
    private look: Look,
  ) {
    this.manipulation = look.manipulation;
    this.group.matrixAutoUpdate = false;
    const meshes: Mesh[] = [];
    model.traverse((node) => {
      if (node instanceof Mesh) meshes.push(node);
    });
    this.frames = description.bodies.map((body, i) => {
      if (!look.furniture && body.joint === "nothing" && !body.name.startsWith("link")) return null;
      const frame = new Group();
      for (const mesh of meshes) {
        if (mesh.name.startsWith(`body${i}_`)) frame.add(this.copied(mesh));
      }
      this.group.add(frame);
      return frame;
    });
    if (look.furniture) {
      for (const mesh of meshes) {
        if (mesh.name.startsWith("stands_")) this.group.add(this.copied(mesh));
      }
    }
    if (look.manipulation !== "ghost") {
      this.group.add(this.region.group, this.followed.group, this.arrows.group, this.plan);
    }
  }

  /** Length at which one metre of the arm appears [m]. */
  get scale(): number {
    return this.group.matrix.getMaxScaleOnAxis();
  }

  /** A point of the room in the base frame. */
  toBase(world: Vector3): Vector3 {
    return world.clone().applyMatrix4(this.group.matrixWorld.clone().invert());
  }

  toWorld(base: Triple): Vector3 {
    return new Vector3(...base).applyMatrix4(this.group.matrixWorld);
  }

  /** An orientation, or a turn, of the room in the base frame. */
  turnToBase(turn: Quaternion): Quaternion {
    const base = new Quaternion().setFromRotationMatrix(this.group.matrixWorld);
    return base.clone().invert().multiply(turn).multiply(base);
  }

  orientationToBase(orientation: Quaternion): Quaternion {
    // Rotation of a scaled matrix: three removes the scale only when it decomposes the matrix.
    const base = new Quaternion();
    this.group.matrixWorld.decompose(new Vector3(), base, new Vector3());
    return base.invert().multiply(orientation);
  }

  follow(state: SceneState, drawn: Region | null = state.drawn): void {
    this.pose(state.bodies);
    this.region.show(drawn, state.active ? 0.3 : 0.1);
    this.followed.show(state.followed, 0);
    this.arrows.show(state.arrows, state.colour);
    this.plan.visible = state.plan.length > 1;
    if (this.plan.visible) {
      this.plan.geometry.dispose();
      this.plan.geometry = new BufferGeometry().setFromPoints(
        state.plan.map((point) => new Vector3(...point)),
      );
    }
  }

  pose(bodies: number[][]): void {
    this.frames.forEach((frame, i) => {
      const pose = bodies[i];
      if (!frame || !pose) return;
      frame.position.set(pose[0]!, pose[1]!, pose[2]!);
      frame.quaternion.set(pose[4]!, pose[5]!, pose[6]!, pose[3]!);
    });
  }

  /** Show which body a pinch would hold, or holds; -1: none. */
  highlight(body: number, colour: string): void {
    if (body === this.highlighted) return;
    for (const [index, shade] of [
      [this.highlighted, "#000000"],
      [body, colour],
    ] as const) {
      this.frames[index]?.traverse((node) => {
        if (node instanceof Mesh && node.material instanceof MeshStandardMaterial) {
          node.material.emissive = new Color(shade);
          node.material.emissiveIntensity = 0.6;
        }
      });
    }
    this.highlighted = body;
  }

  /** The held part nearest to a point of the room. */
  nearest(world: Vector3): Met | null {
    const point = this.toBase(world);
    return this.meet((start, end, radius) => pointToSegment(point, start, end) - radius);
  }

  /** The held part that a ray meets first; `slack` widens it [m]. */
  along(origin: Vector3, direction: Vector3, slack: number): Met | null {
    const from = this.toBase(origin);
    const way = this.toBase(origin.clone().add(direction)).sub(from).normalize();
    return this.meet((start, end, radius) => {
      const { along, distance } = rayToSegment(from, way, start, end);
      const room = radius + slack / this.scale;
      if (distance > room) return Infinity;
      return Math.max(along - Math.sqrt(radius * radius - Math.min(distance, radius) ** 2), 0);
    });
  }

  private meet(distance: (start: Vector3, end: Vector3, radius: number) => number): Met | null {
    let best: Met | null = null;
    this.description.bodies.forEach((body, i) => {
      const frame = this.frames[i];
      if (!frame || body.joint === "nothing") return;
      if (body.joint === null && !this.description.guides) return;
      for (const [ax, ay, az, bx, by, bz, radius] of body.capsules) {
        const start = new Vector3(ax, ay, az).applyQuaternion(frame.quaternion).add(frame.position);
        const end = new Vector3(bx, by, bz).applyQuaternion(frame.quaternion).add(frame.position);
        const d = distance(start, end, radius) * this.scale;
        if (d < (best?.distance ?? Infinity)) best = { joint: body.joint, body: i, distance: d };
      }
    });
    return best;
  }

  /** Copy of a mesh in the colours of this view; the copies use the same geometry. */
  private copied(mesh: Mesh): Mesh {
    const material = (mesh.material as MeshStandardMaterial).clone();
    const { opacity, tint } = this.look;
    if (tint) material.color = new Color(tint);
    material.opacity *= opacity;
    material.transparent = material.opacity < 1;
    material.roughness = 0.75;
    material.metalness = 0;
    const copy = new Mesh(mesh.geometry, material);
    copy.matrixAutoUpdate = true;
    return copy;
  }

  /** Let the real arm show through the virtual one, or not. */
  set opacity(opacity: number) {
    this.look.opacity = opacity;
    for (const frame of this.frames) {
      frame?.traverse((node) => {
        if (node instanceof Mesh) {
          const material = node.material as Material;
          material.opacity = opacity;
          material.transparent = opacity < 1;
          material.needsUpdate = true;
        }
      });
    }
  }
}

/** Edges of a box, and its sides as glass. */
class RegionBox {
  readonly group = new Group();
  private sides: Mesh<BoxGeometry, MeshBasicMaterial>;

  constructor(colour: string) {
    const box = new BoxGeometry(2, 2, 2);
    const glass = new MeshBasicMaterial({ color: colour, transparent: true, depthWrite: false });
    this.sides = new Mesh(box, glass);
    const edges = new LineSegments(new EdgesGeometry(box), new LineBasicMaterial({ color: colour }));
    this.group.add(this.sides, edges);
    const ball = new SphereGeometry(0.02, 12, 8);
    const solid = new MeshBasicMaterial({ color: colour });
    for (const [x, y, z] of CORNERS) {
      const corner = new Mesh(ball, solid);
      corner.position.set(x, y, z);
      this.group.add(corner);
    }
  }

  show(region: Region | null, opacity: number): void {
    this.group.visible = region !== null;
    if (!region) return;
    this.group.position.set(...region.centre);
    this.group.scale.set(...region.half_size);
    this.sides.material.opacity = opacity;
    const [a, b, c] = region.half_size;
    // Corners stay round, whatever the shape of the box.
    for (const corner of this.group.children.slice(2)) {
      corner.scale.set(1 / a, 1 / b, 1 / c);
      corner.visible = opacity > 0;
    }
  }
}

export const CORNERS: Triple[] = [-1, 1].flatMap((x) =>
  [-1, 1].flatMap((y) => [-1, 1].map((z): Triple => [x, y, z])),
);

/** Arrows from the held points to the hands; the colour shows how far the arm follows. */
class Arrows {
  readonly group = new Group();
  private material = new MeshBasicMaterial();
  private shaft = new CylinderGeometry(0.008, 0.008, 1, 10).translate(0, 0.5, 0);
  private head = new ConeGeometry(0.022, 0.05, 12).translate(0, -0.025, 0);

  show(arrows: [Triple, Triple][], colour: string): void {
    this.material.color.set(colour);
    while (this.group.children.length < arrows.length) {
      const arrow = new Group();
      arrow.add(new Mesh(this.shaft, this.material), new Mesh(this.head, this.material));
      this.group.add(arrow);
    }
    this.group.children.forEach((arrow, i) => {
      const ends = arrows[i];
      arrow.visible = ends !== undefined;
      if (!ends) return;
      const [from, to] = [new Vector3(...ends[0]), new Vector3(...ends[1])];
      const way = to.clone().sub(from);
      const length = Math.max(way.length(), 1e-6);
      arrow.position.copy(from);
      arrow.quaternion.setFromUnitVectors(UP, way.divideScalar(length));
      arrow.children[0]!.scale.set(1, length, 1);
      arrow.children[1]!.position.set(0, length, 0);
    });
  }
}
