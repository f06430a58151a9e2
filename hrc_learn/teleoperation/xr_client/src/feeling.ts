// Feedback: pulses of controllers, and text next to the arm.

import { CanvasTexture, Sprite, SpriteMaterial, SRGBColorSpace } from "three";

/** Time from one pulse to the next, and length of a pulse [ms]; the same as for a gamepad. */
const [EVERY, PULSE] = [250, 120];
/** Strength below which there is no pulse, as a fraction of full strength. */
const LEAST = 0.1;

interface Actuator {
  pulse?(strength: number, duration: number): Promise<boolean>;
  playEffect?(kind: "dual-rumble", effect: object): Promise<unknown>;
}

/** Pulses of all controllers, whose strength shows contact or input that the arm does not follow. */
export class Pulses {
  private next = 0;

  /**
   * @param sources Input sources of the session; hands have no motors.
   * @param strengths Strengths of the slow and the quick motor, 0 to 1. A single motor uses the
   *   larger one.
   */
  play(sources: Iterable<XRInputSource>, [slow, quick]: [number, number], now: number): void {
    const strength = Math.max(slow, quick);
    if (strength < LEAST || now < this.next) return;
    this.next = now + EVERY;
    for (const { gamepad } of sources) {
      const pad = gamepad as
        | { hapticActuators?: Actuator[]; vibrationActuator?: Actuator | null }
        | undefined;
      const motor = pad?.hapticActuators?.[0];
      if (motor?.pulse) void motor.pulse(strength, PULSE).catch(() => {});
      else {
        const effect = { duration: PULSE, strongMagnitude: slow, weakMagnitude: quick };
        void pad?.vibrationActuator?.playEffect?.("dual-rumble", effect).catch(() => {});
      }
    }
  }
}

/** Text in the room that faces the person. */
export class Label {
  readonly sprite: Sprite;
  private canvas = document.createElement("canvas");
  private texture: CanvasTexture;
  private shown = "";

  /** @param height Height of a line [m]. */
  constructor(private height: number) {
    this.texture = new CanvasTexture(this.canvas);
    this.sprite = new Sprite(new SpriteMaterial({ depthTest: false }));
    this.sprite.renderOrder = 10;
    this.sprite.visible = false;
  }

  show(lines: string[], colour: string): void {
    this.sprite.visible = lines.length > 0;
    const key = JSON.stringify([lines, colour]);
    if (key === this.shown || !lines.length) return;
    this.shown = key;
    const paper = this.canvas.getContext("2d")!;
    const font = "600 30px system-ui, sans-serif";
    paper.font = font;
    const width = Math.ceil(Math.max(...lines.map((line) => paper.measureText(line).width))) + 36;
    const height = 40 * lines.length + 16;
    this.canvas.width = width;
    this.canvas.height = height;
    paper.fillStyle = "rgba(28, 37, 48, 0.85)";
    paper.beginPath();
    paper.roundRect(0, 0, width, height, 14);
    paper.fill();
    paper.fillStyle = colour;
    paper.fillRect(8, 10, 6, height - 20);
    paper.font = font;
    paper.fillStyle = "#f4f6f8";
    lines.forEach((line, i) => paper.fillText(line, 22, 40 * i + 36));
    // A texture keeps the size with which it was first drawn.
    this.texture.dispose();
    this.texture = new CanvasTexture(this.canvas);
    this.texture.colorSpace = SRGBColorSpace;
    this.sprite.material.map = this.texture;
    this.sprite.material.needsUpdate = true;
    this.sprite.scale.set((width / height) * this.height * lines.length, this.height * lines.length, 1);
  }
}
