// Hands, controllers, fingers on a screen and the mouse, as pointers that pinch.

import { Matrix4, Quaternion, Ray, Raycaster, Vector2, Vector3, type Camera } from "three";
import type { HandName } from "./protocol";

export interface Pointer {
  hand: HandName;
  pinched: boolean;
  /** Point between thumb and index finger, or of the controller; null: a pointer on a screen. */
  position: Vector3 | null;
  orientation: Quaternion;
  /** Tip of the index finger, if there is one. */
  tip: Vector3 | null;
  ray: Ray;
  /** Frame of the ray. */
  aim: Matrix4;
  source: XRInputSource | null;
}

/** All input sources of an immersive session. */
export class XrInputs {
  private pinching = new Set<XRInputSource>();

  constructor(session: XRSession) {
    session.addEventListener("selectstart", ({ inputSource }) => this.pinching.add(inputSource));
    session.addEventListener("selectend", ({ inputSource }) => this.pinching.delete(inputSource));
    session.addEventListener("inputsourceschange", ({ removed }) => {
      for (const source of removed) this.pinching.delete(source);
    });
  }

  /** The present pointers; a hand that is not tracked is left out, and so holds nothing. */
  read(frame: XRFrame, space: XRReferenceSpace): Pointer[] {
    // While a menu of the headset is open, hands belong to the menu.
    if (frame.session.visibilityState !== "visible") return [];
    const pointers = new Map<HandName, Pointer>();
    for (const source of frame.session.inputSources) {
      const pointer = this.pointer(source, frame, space);
      if (pointer && !pointers.has(pointer.hand)) pointers.set(pointer.hand, pointer);
    }
    return [...pointers.values()];
  }

  private pointer(source: XRInputSource, frame: XRFrame, space: XRReferenceSpace): Pointer | null {
    const aimed = frame.getPose(source.targetRaySpace, space);
    if (!aimed) return null;
    const aim = new Matrix4().fromArray(aimed.transform.matrix);
    const origin = new Vector3().setFromMatrixPosition(aim);
    const direction = new Vector3(0, 0, -1).transformDirection(aim);
    const common = {
      pinched: this.pinching.has(source),
      ray: new Ray(origin, direction),
      aim,
      source,
    };
    if (source.targetRayMode === "screen") {
      return { ...common, hand: "touch", position: null, orientation: new Quaternion(), tip: null };
    }
    const hand = source.handedness === "left" ? "left" : "right";
    const held = source.gripSpace && frame.getPose(source.gripSpace, space);
    const joint = (name: XRHandJoint) => {
      const at = source.hand?.get(name);
      return at ? (frame.getJointPose?.(at, space) ?? null) : null;
    };
    const tip = vector(joint("index-finger-tip"));
    const thumb = vector(joint("thumb-tip"));
    const turned = held ?? joint("wrist");
    const position = tip && thumb ? tip.clone().add(thumb).multiplyScalar(0.5) : vector(held);
    if (!position || !turned) return null;
    const { x, y, z, w } = turned.transform.orientation;
    return { ...common, hand, position, orientation: new Quaternion(x, y, z, w), tip };
  }
}

function vector(pose: XRPose | null | undefined): Vector3 | null {
  return pose ? new Vector3().setFromMatrixPosition(new Matrix4().fromArray(pose.transform.matrix)) : null;
}

/** The mouse, or a finger, on the page without a headset. */
export class ScreenInput {
  private place = new Vector2();
  private pinched = false;
  private there = false;

  constructor(canvas: HTMLCanvasElement) {
    const at = (event: PointerEvent) => {
      const box = canvas.getBoundingClientRect();
      this.place.set(
        (2 * (event.clientX - box.left)) / box.width - 1,
        1 - (2 * (event.clientY - box.top)) / box.height,
      );
      this.there = true;
    };
    canvas.addEventListener("pointermove", at);
    canvas.addEventListener("pointerdown", (event) => {
      at(event);
      this.pinched = event.button === 0 && event.isPrimary;
      if (this.pinched) canvas.setPointerCapture(event.pointerId);
    });
    const letGo = () => (this.pinched = false);
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"] as const) {
      canvas.addEventListener(name, letGo);
    }
    addEventListener("blur", letGo);
    document.addEventListener("visibilitychange", letGo);
  }

  read(camera: Camera): Pointer[] {
    if (!this.there) return [];
    const caster = new Raycaster();
    caster.setFromCamera(this.place, camera);
    return [
      {
        hand: "touch",
        pinched: this.pinched,
        position: null,
        orientation: new Quaternion(),
        tip: null,
        ray: caster.ray.clone(),
        aim: camera.matrixWorld.clone(),
        source: null,
      },
    ];
  }
}
