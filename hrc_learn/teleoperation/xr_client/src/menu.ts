// All buttons, once as HTML and once as a panel in the room.

import {
  CanvasTexture,
  Mesh,
  MeshBasicMaterial,
  PlaneGeometry,
  Ray,
  SRGBColorSpace,
  Vector3,
  type Object3D,
} from "three";
import type { Pointer } from "./inputs";
import type { Drag, Tool } from "./holding";

export interface Button {
  label: string;
  pressed?: boolean;
  disabled?: boolean;
  press(): void;
}

export interface MenuState {
  words: string;
  /** Colour of the text. */
  colour: string;
  buttons: Button[];
}

/** Buttons on the page, and over the view of a phone. */
export class HtmlMenu {
  private words = document.getElementById("words")!;
  private shown = "";

  constructor(
    private overlay: HTMLElement,
    private list: HTMLElement,
    task: HTMLInputElement | null,
  ) {
    if (task) list.before(task);
    // A touch on a button must not also act on the scene behind it.
    overlay.addEventListener("beforexrselect", (event) => event.preventDefault());
  }

  show({ words, colour, buttons }: MenuState): void {
    if (this.words.textContent !== words) this.words.textContent = words;
    this.overlay.style.borderLeft = `0.4rem solid ${colour}`;
    const key = JSON.stringify(buttons);
    if (key === this.shown) return;
    this.shown = key;
    buttons.forEach((button, i) => {
      const element = (this.list.children[i] as HTMLButtonElement) ?? this.list.appendChild(document.createElement("button"));
      element.textContent = button.label;
      element.disabled = button.disabled ?? false;
      if (button.pressed === undefined) element.removeAttribute("aria-pressed");
      else element.setAttribute("aria-pressed", String(button.pressed));
      element.onclick = () => button.press();
    });
    while (this.list.children.length > buttons.length) this.list.lastChild!.remove();
  }
}

const [WIDTH, HEIGHT] = [512, 744];
/** Width of the panel [m], readable at arm's length. */
const SIZE = 0.34;
const [TOP, ROW, COLUMNS, GAP] = [232, 56, 2, 8];
/** Distance beyond which a ray does not reach a panel [m]. */
const FURTHEST = 3;
/** Distance from the panel within which a fingertip presses [m]. */
const DEPTH = 0.015;

/** A panel in the room. A ray and a pinch, or a fingertip, press its buttons; its upper part is
 * the handle for moving it. */
export class Panel implements Tool {
  readonly mesh: Mesh<PlaneGeometry, MeshBasicMaterial>;
  private canvas = document.createElement("canvas");
  private texture: CanvasTexture;
  private state: MenuState = { words: "", colour: "#ffffff", buttons: [] };
  private shown = "";
  private poking = new Set<string>();

  constructor() {
    this.canvas.width = WIDTH;
    this.canvas.height = HEIGHT;
    this.texture = new CanvasTexture(this.canvas);
    this.texture.colorSpace = SRGBColorSpace;
    this.mesh = new Mesh(
      new PlaneGeometry(SIZE, (SIZE * HEIGHT) / WIDTH),
      new MeshBasicMaterial({ map: this.texture, transparent: true }),
    );
    this.mesh.visible = false;
  }

  /** Place the panel in front of a person, on the left. */
  stand(head: Object3D["matrixWorld"]): void {
    const eye = new Vector3().setFromMatrixPosition(head);
    const level = new Vector3(0, 0, -1).transformDirection(head).setY(0).normalize();
    const left = new Vector3(level.z, 0, -level.x);
    this.mesh.position.copy(eye).addScaledVector(level, 0.5).addScaledVector(left, 0.3);
    this.mesh.position.y -= 0.15;
    this.mesh.lookAt(eye);
  }

  show(state: MenuState): void {
    this.state = state;
    const key = JSON.stringify(state);
    if (key === this.shown) return;
    this.shown = key;
    this.draw();
    this.texture.needsUpdate = true;
  }

  begin(pointer: Pointer): Drag | null {
    const place = this.meet(pointer.ray);
    if (!place) return null;
    if (place.y >= TOP || !pointer.position) {
      this.press(place);
      return { move: () => {}, end: () => {} };
    }
    const offset = this.mesh.position.clone().sub(pointer.position);
    return {
      move: ({ position }) => this.mesh.position.copy(position!).add(offset),
      end: () => {},
    };
  }

  /** Let fingertips press without a pinch. */
  poke(pointers: Pointer[]): void {
    for (const { hand, tip } of pointers) {
      const at = tip && this.mesh.visible ? this.mesh.worldToLocal(tip.clone()) : null;
      const place = at && this.pixel(at);
      const touches = place !== null && Math.abs(at!.z) < DEPTH;
      if (touches && !this.poking.has(hand)) this.press(place);
      if (touches) this.poking.add(hand);
      else if (!at || at.z > 2 * DEPTH || !place) this.poking.delete(hand);
    }
  }

  /** Point of the panel that a ray meets, in pixels. */
  meet(ray: Ray): { x: number; y: number } | null {
    if (!this.mesh.visible) return null;
    const local = ray.clone().applyMatrix4(this.mesh.matrixWorld.clone().invert());
    const along = -local.origin.z / local.direction.z;
    if (!(along > 0 && along < FURTHEST)) return null;
    return this.pixel(local.at(along, new Vector3()));
  }

  private pixel(local: Vector3): { x: number; y: number } | null {
    const x = WIDTH / 2 + (local.x * WIDTH) / SIZE;
    const y = HEIGHT / 2 - (local.y * WIDTH) / SIZE;
    return x >= 0 && x < WIDTH && y >= 0 && y < HEIGHT ? { x, y } : null;
  }

  private press(place: { x: number; y: number }): void {
    const button = this.state.buttons.find((_, i) => {
      const { x, y, w, h } = cell(i);
      return place.x >= x && place.x < x + w && place.y >= y && place.y < y + h;
    });
    if (button && !button.disabled) button.press();
  }

  private draw(): void {
    const paper = this.canvas.getContext("2d")!;
    paper.clearRect(0, 0, WIDTH, HEIGHT);
    paper.fillStyle = "rgba(28, 37, 48, 0.92)";
    paper.beginPath();
    paper.roundRect(0, 0, WIDTH, HEIGHT, 24);
    paper.fill();
    paper.fillStyle = this.state.colour;
    paper.fillRect(24, 22, 12, TOP - 44);
    paper.fillStyle = "#f4f6f8";
    paper.font = "25px system-ui, sans-serif";
    let y = 44;
    for (const line of this.state.words.split("\n").flatMap((text) => wrapped(paper, text, WIDTH - 76))) {
      if (y > TOP - 16) break;
      paper.fillText(line, 52, y);
      y += 31;
    }
    paper.textAlign = "center";
    this.state.buttons.forEach((button, i) => {
      const { x, y, w, h } = cell(i);
      paper.fillStyle = button.pressed ? "#0072B2" : "#3d4b5a";
      paper.globalAlpha = button.disabled ? 0.4 : 1;
      paper.beginPath();
      paper.roundRect(x, y, w, h, 12);
      paper.fill();
      paper.fillStyle = "#f4f6f8";
      paper.fillText(button.label, x + w / 2, y + h / 2 + 9, w - 12);
    });
    paper.globalAlpha = 1;
    paper.textAlign = "start";
  }
}

function cell(index: number): { x: number; y: number; w: number; h: number } {
  const w = (WIDTH - GAP * (COLUMNS + 1)) / COLUMNS;
  const x = GAP + (index % COLUMNS) * (w + GAP);
  return { x, y: TOP + Math.floor(index / COLUMNS) * ROW, w, h: ROW - GAP };
}

function wrapped(paper: CanvasRenderingContext2D, text: string, width: number): string[] {
  const lines: string[] = [];
  let line = "";
  for (const word of text.split(" ")) {
    const longer = line ? `${line} ${word}` : word;
    if (paper.measureText(longer).width > width && line) {
      lines.push(line);
      line = word;
    } else line = longer;
  }
  return [...lines, line];
}
