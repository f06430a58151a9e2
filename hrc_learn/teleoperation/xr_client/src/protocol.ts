// Messages between this client and `hrc page`, which gate/messages.py checks, and their
// connection.

import type { Quadruple, Triple } from "./geometry";

export interface Region {
  centre: Triple;
  half_size: Triple;
}

/** Data that stays constant while a page is served. */
export interface Description {
  bodies: {
    name: string;
    /** Joint that moves the link, from 1; null: the end effector; "nothing": cannot be held. */
    joint: number | null | "nothing";
    /** Both end points and the radius of each capsule [m]. */
    capsules: [number, number, number, number, number, number, number][];
  }[];
  /** Points of the workplace that a person touches to place the arm [m]. */
  touch_points: Triple[];
  guides: boolean;
  draws: boolean;
  task: string;
  /** Width of the open gripper [m]. */
  opening: number;
}

/** State of the scene, sent whenever it changes. */
export interface SceneState {
  /** Position [m] and orientation (wxyz) of each body. */
  bodies: number[][];
  links: Triple[];
  tool: Quadruple;
  arrows: [Triple, Triple][];
  colour: string;
  followed: Region | null;
  drawn: Region | null;
  active: boolean;
  plan: Triple[];
}

/** Status of the session, sent ten times a second. */
export interface Status {
  role: "leads" | "watches";
  taken: boolean;
  asked: boolean;
  words: string;
  recording: "ready" | "recording" | "stopped";
  seconds: number;
  saved: number;
  note: string;
  doing: string;
  task: string;
  pushed: boolean;
  followed: number;
  pulse: [number, number];
  reasons: string[];
  felt: string[];
}

export type HandName = "left" | "right" | "touch";

export interface Grip {
  hand: HandName;
  joint: number | null;
  start: Triple;
  pointer: Triple;
  orientation: Quadruple | null;
}

export interface TrackedHand {
  hand: "left" | "right";
  position: Triple;
  orientation: Quadruple;
}

export type Message =
  | { type: "hello"; wants: "scene" }
  | { type: "lead"; wish: "ask" | "hand_over" }
  | { type: "ask"; request: "start" | "stop" | "save" | "discard" | "home" | "finish" }
  | { type: "task"; task: string }
  | { type: "gripper"; width: number }
  | { type: "region"; centre: Triple; half_size: Triple; active: boolean }
  | { type: "target"; point: Triple | null }
  | { type: "hands"; grips: Grip[]; tracked: TrackedHand[]; sent: number };

/** Largest coordinate of a point along each axis [m]: slightly less than REACH of the gate. */
const REACH = 9.9;
export const within = (point: Triple): boolean => point.every((x) => Math.abs(x) <= REACH);

/** Interface of door.js, loaded first: it keeps the secret and adds it to each `fetch`. */
declare const hrcDoor: { socket(route: string): { url: string; protocols: string[] } };

/** The socket, in a worker that sends signs of life even while this page draws. */
export class Connection {
  status: Status | null = null;
  scene: SceneState | null = null;
  /** Reason why the connection has ended; empty while it is open. */
  over = "";
  private worker = new Worker("/static/beat.js");
  private greeted = false;

  constructor() {
    this.worker.onmessage = ({ data }) => this.hear(data);
    this.worker.postMessage({ open: hrcDoor.socket("session") });
    setInterval(() => this.alive(), 50);
  }

  /** Report that the page responds; each frame calls this too, since headsets slow timers down. */
  alive(): void {
    this.worker.postMessage({ alive: true });
  }

  send(message: Message): void {
    this.worker.postMessage({ send: message });
  }

  private hear(data: {
    type: string;
    status?: Status;
    scene?: SceneState;
    words?: string;
  }): void {
    if (data.type === "state") {
      this.status = data.status ?? this.status;
      this.scene = data.scene ?? this.scene;
      // The worker drops messages that are sent before the socket is open.
      if (!this.greeted) this.send({ type: "hello", wants: "scene" });
      this.greeted = true;
    } else if (!this.over) {
      this.over = data.words || "The program does not answer any more. Reload the page to connect again.";
    }
  }
}
