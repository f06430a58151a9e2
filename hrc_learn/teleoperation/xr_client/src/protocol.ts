// What is said between this client and `hrc page`, as gate/messages.py checks it, and the
// connection that carries it.

import type { Quadruple, Triple } from "./geometry";

export interface Region {
  centre: Triple;
  half_size: Triple;
}

/** Of what does not change while a page is served. */
export interface Description {
  bodies: {
    name: string;
    /** Joint that moves the link, from 1; null: the end effector; nothing: it is not held. */
    joint: number | null | "nothing";
    /** Ends and radius of each [m]. */
    capsules: [number, number, number, number, number, number, number][];
  }[];
  /** Of the workplace, that a person touches to place the arm [m]. */
  touch_points: Triple[];
  guides: boolean;
  draws: boolean;
  task: string;
  /** Width of the open gripper [m]. */
  opening: number;
}

/** As often as it changes. */
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

/** Ten times a second. */
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

/** Furthest that a point may lie from the arm, along each axis [m]: REACH of the gate, less a bit. */
const REACH = 9.9;
export const within = (point: Triple): boolean => point.every((x) => Math.abs(x) <= REACH);

/** Of door.js, which the page loads first: it keeps the secret and adds it to each `fetch`. */
declare const hrcDoor: { socket(route: string): { url: string; protocols: string[] } };

/** The socket, held by a worker that goes on giving signs of life while this page draws. */
export class Connection {
  status: Status | null = null;
  scene: SceneState | null = null;
  /** Why it is over; empty while it is not. */
  over = "";
  private worker = new Worker("/static/beat.js");
  private greeted = false;

  constructor() {
    this.worker.onmessage = ({ data }) => this.hear(data);
    this.worker.postMessage({ open: hrcDoor.socket("session") });
    setInterval(() => this.alive(), 50);
  }

  /** The page reacts; called by each frame as well, as headsets slow timers down. */
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
      // The worker drops what is said before the socket is open.
      if (!this.greeted) this.send({ type: "hello", wants: "scene" });
      this.greeted = true;
    } else if (!this.over) {
      this.over = data.words || "The program does not answer any more. Reload to look for it again.";
    }
  }
}
