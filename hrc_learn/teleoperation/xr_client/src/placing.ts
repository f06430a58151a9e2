// Placements of the arm and its twin in the room. They are kept between sessions, by anchors if
// the headset supports them.

import { Matrix4, Quaternion, Vector3 } from "three";
import { triple, yawOf, type Placement, type Triple } from "./geometry";

interface Stored {
  arm: Placement | null;
  twin: Placement | null;
  /** Name of an anchor that the headset remembers. */
  anchor: string | null;
}

const KEY = "hrc-placing";
const TWIN_SCALE = 0.3;
/** Height of the base above the floor until a person has placed it [m]: that of a table. */
const TABLE = 0.72;

export class Placing {
  arm: Placement;
  twin: Placement;
  /** True if a person has placed the arm, now or in an earlier session. */
  placed: boolean;
  private anchor: XRAnchor | null = null;
  private stored: Stored;

  constructor() {
    this.stored = read();
    this.placed = this.stored.arm !== null;
    this.arm = this.stored.arm ?? { position: [0, TABLE, -1.1], yaw: -Math.PI / 2, scale: 1 };
    this.twin = this.stored.twin ?? { position: [0.35, 1, -0.5], yaw: -Math.PI / 2, scale: TWIN_SCALE };
  }

  /** Begin a session: an arm that no person has placed appears in front of the person. */
  async begin(session: XRSession, head: Matrix4): Promise<void> {
    const eye = new Vector3().setFromMatrixPosition(head);
    const turn = yawOf(new Quaternion().setFromRotationMatrix(head));
    const ahead = (x: number, y: number, z: number): Triple =>
      triple(new Vector3(x, 0, z).applyAxisAngle(new Vector3(0, 1, 0), turn).add(eye).setY(y));
    if (!this.stored.arm) {
      this.arm = { position: ahead(0, TABLE, -1.1), yaw: turn - Math.PI / 2, scale: 1 };
    }
    if (!this.stored.twin) {
      const position = ahead(0.35, eye.y - 0.45, -0.5);
      this.twin = { position, yaw: turn - Math.PI / 2, scale: TWIN_SCALE };
    }
    this.anchor = null;
    if (this.stored.anchor && session.restorePersistentAnchor) {
      try {
        this.anchor = await session.restorePersistentAnchor(this.stored.anchor);
      } catch {
        this.stored.anchor = null; // the headset has forgotten the anchor: the stored pose is kept
      }
    }
  }

  /** Follow the anchor, which moves when the headset corrects its map of the room. */
  follow(frame: XRFrame, space: XRReferenceSpace): void {
    const pose = this.anchor && frame.getPose(this.anchor.anchorSpace, space);
    if (!pose) return;
    const matrix = new Matrix4().fromArray(pose.transform.matrix);
    const turn = new Quaternion().setFromRotationMatrix(matrix);
    const position = triple(new Vector3().setFromMatrixPosition(matrix));
    this.arm = { ...this.arm, position, yaw: yawOf(turn) };
  }

  /** Place the arm, and store the placement. */
  place(arm: Placement, frame: XRFrame | null, space: XRReferenceSpace | null): void {
    this.arm = arm;
    this.placed = true;
    const before = this.anchor;
    this.anchor = null;
    before?.delete();
    this.stored = { ...this.stored, arm, anchor: null };
    this.write();
    if (frame && space) void this.hold(arm, frame, space);
  }

  stand(position: Vector3): void {
    this.twin = { ...this.twin, position: triple(position) };
    this.stored.twin = this.twin;
    this.write();
  }

  private async hold(arm: Placement, frame: XRFrame, space: XRReferenceSpace): Promise<void> {
    const turn = new Quaternion().setFromAxisAngle(new Vector3(0, 1, 0), arm.yaw);
    const [x, y, z] = arm.position;
    const pose = new XRRigidTransform({ x, y, z }, { x: turn.x, y: turn.y, z: turn.z, w: turn.w });
    try {
      const anchor = await frame.createAnchor?.(pose, space);
      if (!anchor || this.arm !== arm) return;
      this.anchor = anchor;
      const handle = await anchor.requestPersistentHandle?.();
      if (handle && this.anchor === anchor) {
        this.stored.anchor = handle;
        this.write();
      }
    } catch {
      // Without anchors, the placement is as accurate as the tracking of the headset.
    }
  }

  private write(): void {
    localStorage.setItem(KEY, JSON.stringify(this.stored));
  }
}

function read(): Stored {
  const empty = { arm: null, twin: null, anchor: null };
  try {
    return { ...empty, ...JSON.parse(localStorage.getItem(KEY) ?? "{}") };
  } catch {
    return empty;
  }
}
