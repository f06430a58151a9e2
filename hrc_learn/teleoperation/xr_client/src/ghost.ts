// The last demonstration, replayed by a translucent arm (the ghost).

import type { SceneState } from "./protocol";

/** Longest motion that is kept [s]: about 20 MB at 60 poses per second. */
const LONGEST = 300;

export class Tape {
  private frames: { time: number; bodies: number[][] }[] = [];
  private recording = false;
  private played: number | null = null;
  private last: SceneState | null = null;

  get empty(): boolean {
    return this.frames.length < 2;
  }

  get playing(): boolean {
    return this.played !== null;
  }

  /** Store the shown poses while a demonstration is recorded; a new one replaces the last. */
  note(scene: SceneState, recording: boolean, now: number): void {
    if (recording && !this.recording) this.frames = [];
    this.recording = recording;
    if (!recording || scene === this.last) return;
    this.last = scene;
    if (this.frames[0] && now - this.frames[0].time > 1e3 * LONGEST) return;
    this.frames.push({ time: now, bodies: scene.bodies });
  }

  play(now: number): void {
    this.played = this.played === null && !this.empty ? now : null;
  }

  /** Poses of the bodies at this time of the replay; null: the replay is over. */
  bodies(now: number): number[][] | null {
    if (this.played === null) return null;
    const time = this.frames[0]!.time + now - this.played;
    const next = this.frames.findIndex((frame) => frame.time > time);
    if (next < 0) {
      this.played = null;
      return null;
    }
    return this.frames[Math.max(next - 1, 0)]!.bodies;
  }
}
