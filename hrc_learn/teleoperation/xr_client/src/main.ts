// The client: draws the state that `hrc page` sends, and sends the actions of hands.

import {
  Color,
  GridHelper,
  HemisphereLight,
  DirectionalLight,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  PerspectiveCamera,
  Scene,
  SphereGeometry,
  Vector3,
  WebGLRenderer,
  type Object3D,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { ArmView } from "./arm_view";
import { Label, Pulses } from "./feeling";
import { fitPlacement, placementMatrix, quadruple, triple } from "./geometry";
import { Tape } from "./ghost";
import { Drawing, Holding, Marking, MovingTwin, Touching, type Drag, type Tool } from "./holding";
import { ScreenInput, XrInputs, type Pointer } from "./inputs";
import { HtmlMenu, Panel, type Button, type MenuState } from "./menu";
import { Placing } from "./placing";
import { Connection, within, type Description, type HandName, type TrackedHand } from "./protocol";

/** Gains of the clutch, from coarse to fine. */
const GAINS = [1, 0.5, 0.25, 2];
/** Period of sending poses of hands that hold nothing [ms]: the period of recorded frames. */
const HANDS_EVERY = 20;
/** Largest error of touched points [m]: above it, a wrong point was touched. */
const MISSED = 0.03;
const GREY = "#9AA0A6";
const VERMILION = "#D55E00";
const ORANGE = "#E69F00";

type Mode = "lead" | "region" | "target" | "place";

class Client {
  private connection = new Connection();
  private scene = new Scene();
  private camera = new PerspectiveCamera(50, 1, 0.01, 50);
  private renderer: WebGLRenderer;
  private orbit: OrbitControls;
  private placing = new Placing();
  private arm: ArmView;
  private twin: ArmView;
  private ghost: ArmView;
  private tape = new Tape();
  private panel = new Panel();
  private menu: HtmlMenu;
  private task = document.createElement("input");
  private said = new Label(0.028);
  private pulses = new Pulses();
  private tips = new Map<HandName, { ball: Mesh; label: Label }>();
  private settings = { gain: 1, turns: false };
  private mode: Mode = "lead";
  private showTwin = true;
  private solid = true;
  private remark = "";
  private drags = new Map<HandName, { drag: Drag | null; last: Pointer }>();
  private held = false;
  private handsTold = 0;
  private screen: ScreenInput;
  private inputs: XrInputs | null = null;
  private frame: XRFrame | null = null;
  private backdrop: Object3D;
  private ready = false; // hands hold only bodies that the person sees

  private holding: Holding;
  private drawing: Drawing;
  private tools: Record<Mode, Tool[]>;
  private touching: Touching;

  constructor(
    canvas: HTMLCanvasElement,
    private description: Description,
    model: Object3D,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.xr.enabled = true;
    this.renderer.xr.setReferenceSpaceType("local-floor");
    this.scene.add(new HemisphereLight("#ffffff", "#8d8d99", 2.2));
    const sun = new DirectionalLight("#ffffff", 1.6);
    sun.position.set(1, 3, 2);
    this.scene.add(sun);
    this.backdrop = new GridHelper(6, 24, "#b9c2ca", "#cdd5db");
    this.scene.add(this.backdrop);

    this.arm = new ArmView(model, description, {
      manipulation: "close",
      furniture: true,
      opacity: 1,
    });
    this.twin = new ArmView(model, description, {
      manipulation: "remote",
      furniture: false,
      opacity: 0.75,
      tint: "#56B4E9",
    });
    this.ghost = new ArmView(model, description, {
      manipulation: "ghost",
      furniture: false,
      opacity: 0.35,
      tint: "#CC79A7",
    });
    this.scene.add(this.arm.group, this.twin.group, this.ghost.group);
    this.scene.add(this.panel.mesh, this.said.sprite);

    this.orbit = new OrbitControls(this.camera, canvas);
    this.screen = new ScreenInput(canvas);
    const views = () => (this.showTwin ? [this.arm, this.twin] : [this.arm]);
    const tool = () => this.connection.scene?.links.at(-1) ?? null;
    this.holding = new Holding(views, tool, description.guides, this.settings, () =>
      this.camera.getWorldDirection(new Vector3()),
    );
    this.drawing = new Drawing(
      views,
      () => this.connection.scene?.drawn ?? null,
      (region) => {
        const active = this.connection.scene?.active ?? false;
        this.connection.send({ type: "region", ...region, active });
      },
    );
    const marking = new Marking(views, (point) => this.connection.send({ type: "target", point }));
    this.touching = new Touching(description.touch_points.length, (touched) => this.place(touched));
    const twin = new MovingTwin(
      () => (this.showTwin ? this.twin : null),
      (position) => this.placing.stand(position),
    );
    this.tools = {
      lead: [this.panel, twin, this.holding],
      region: [this.panel, twin, this.drawing],
      target: [this.panel, marking],
      place: [this.panel, this.touching],
    };

    this.task.placeholder = "Task: what is demonstrated";
    this.task.value = description.task;
    this.task.maxLength = 200;
    this.task.onchange = () => this.name(this.task.value);
    this.menu = new HtmlMenu(
      document.getElementById("overlay")!,
      document.getElementById("buttons")!,
      description.guides ? this.task : null,
    );
    addEventListener("resize", () => this.resize());
    this.resize();
    this.frameWorkplace();
    this.renderer.setAnimationLoop((time, frame) => this.draw(time, frame ?? null));
  }

  /** Enter AR, or VR if the headset has no cameras. */
  private async enter(mode: XRSessionMode): Promise<void> {
    const overlay = document.getElementById("overlay")!;
    const session = await navigator.xr!.requestSession(mode, {
      requiredFeatures: ["local-floor"],
      optionalFeatures: ["hand-tracking", "anchors", "dom-overlay"],
      domOverlay: { root: overlay },
    });
    this.letGo();
    this.inputs = new XrInputs(session);
    session.addEventListener("end", () => this.left());
    this.ready = false;
    await this.renderer.xr.setSession(session);
    this.backdrop.visible = session.environmentBlendMode === "opaque";
    // On a phone the buttons lie over the view.
    this.panel.mesh.visible = !session.domOverlayState || session.domOverlayState.type !== "screen";
  }

  private left(): void {
    this.letGo();
    this.inputs = this.frame = null;
    this.panel.mesh.visible = false;
    this.backdrop.visible = true;
    this.resize();
    this.frameWorkplace();
  }

  private draw(time: number, frame: XRFrame | null): void {
    this.connection.alive();
    this.frame = frame;
    const space = this.renderer.xr.getReferenceSpace();
    let pointers: Pointer[] = [];
    if (frame && space && this.inputs) {
      this.begin(frame, space);
      this.placing.follow(frame, space);
      if (this.ready) pointers = this.inputs.read(frame, space);
    } else if (!this.renderer.xr.isPresenting) {
      this.orbit.update();
      pointers = this.screen.read(this.camera);
    }
    this.stand(this.arm, placementMatrix(this.placing.arm));
    this.stand(this.twin, placementMatrix(this.placing.twin));
    this.twin.group.visible = this.showTwin;
    const { scene, status } = this.connection;
    if (scene) {
      const drawn = this.description.draws ? (this.drawing.region ?? scene.drawn) : null;
      this.arm.follow(scene, drawn);
      this.twin.follow(scene, drawn);
      this.tape.note(scene, status?.recording === "recording", time);
    }
    const replayed = this.tape.bodies(time);
    this.ghost.group.visible = replayed !== null;
    if (replayed) {
      this.stand(this.ghost, placementMatrix(this.placing.arm));
      this.ghost.pose(replayed);
    }
    this.scene.updateMatrixWorld();
    if (scene) this.act(pointers, time);
    this.panel.poke(pointers);
    this.cues(pointers);
    const state = this.menuState();
    this.menu.show(state);
    if (this.panel.mesh.visible) this.panel.show(state);
    this.feel(time);
    this.renderer.render(this.scene, this.camera);
  }

  /** The first frame of a session gives the position of the person. */
  private begin(frame: XRFrame, space: XRReferenceSpace): void {
    const pose = this.ready ? null : frame.getViewerPose(space);
    if (!pose) return;
    const head = new Matrix4().fromArray(pose.transform.matrix);
    this.panel.stand(head);
    void this.placing.begin(frame.session, head);
    this.ready = true;
  }

  /** Begin, continue and end the action of each hand, and send it. */
  private act(pointers: Pointer[], time: number): void {
    for (const pointer of pointers) {
      const before = this.drags.get(pointer.hand);
      if (pointer.pinched && !before) {
        // A pinch that no tool handles still counts as a pinch: it holds no body that it meets later.
        let drag: Drag | null = null;
        for (const tool of this.tools[this.mode]) if ((drag ??= tool.begin(pointer))) break;
        this.drags.set(pointer.hand, { drag, last: pointer });
        this.orbit.enabled = drag === null;
        drag?.move(pointer);
      } else if (pointer.pinched && before) {
        before.drag?.move(pointer);
      }
    }
    for (const [hand, { drag }] of this.drags) {
      if (pointers.some((pointer) => pointer.hand === hand && pointer.pinched)) continue;
      drag?.end();
      this.drags.delete(hand);
      this.orbit.enabled = true;
    }
    const grips = [...this.holding.grips.values()];
    const tracked = this.tracked(pointers);
    const due = tracked.length > 0 && time - this.handsTold >= HANDS_EVERY;
    if (grips.length || this.held || due) {
      const sent = performance.now() / 1e3;
      this.connection.send({ type: "hands", grips, tracked, sent });
      this.handsTold = time;
    }
    this.held = grips.length > 0;
  }

  private tracked(pointers: Pointer[]): TrackedHand[] {
    return pointers.flatMap(({ hand, position, orientation }) => {
      if (!position || hand === "touch") return [];
      const at = triple(this.arm.toBase(position));
      const turned = quadruple(this.arm.orientationToBase(orientation));
      return within(at) ? [{ hand, position: at, orientation: turned }] : [];
    });
  }

  private letGo(): void {
    for (const { drag } of this.drags.values()) drag?.end();
    this.drags.clear();
    if (this.held) this.connection.send({ type: "hands", grips: [], tracked: [], sent: 0 });
    this.held = false;
  }

  private choose(mode: Mode): void {
    this.mode = this.mode === mode ? "lead" : mode;
  }

  private place(touched: Vector3[]): void {
    const { placement, error } = fitPlacement(this.description.touch_points, touched);
    const missed = `${Math.round(1e3 * error)} mm`;
    if (error > MISSED) {
      this.remark = `The points miss by ${missed}: touch them again, in their order.`;
      return;
    }
    this.placing.place(placement, this.frame, this.renderer.xr.getReferenceSpace());
    this.remark = `The arm is placed; the points miss by ${missed}.`;
    this.mode = "lead";
  }

  private name(task: string): void {
    this.connection.send({ type: "task", task });
    if (!task.trim()) return;
    const names = [task, ...taskNames().filter((name) => name !== task)].slice(0, 8);
    localStorage.setItem(TASKS, JSON.stringify(names));
  }

  private menuState(): MenuState {
    const { connection, description } = this;
    const { status, scene, over } = connection;
    if (over) return { words: over, colour: VERMILION, buttons: [] };
    if (!status || !scene) return { words: "Waiting for the arm ...", colour: GREY, buttons: [] };
    const buttons: Button[] = [];
    const add = (label: string, press: () => void, more: Partial<Button> = {}) =>
      buttons.push({ label, press, ...more });
    if (!this.renderer.xr.isPresenting) {
      for (const mode of modes) add(mode.label, () => void this.enter(mode.mode));
    }
    if (status.role === "watches") {
      const words = status.taken ? "You are watching: another person leads." : "No person leads.";
      const lead = () => connection.send({ type: "lead", wish: "ask" });
      add("Ask to lead", lead, { disabled: status.asked });
      return { words, colour: GREY, buttons };
    }
    if (status.asked) add("Hand over", () => connection.send({ type: "lead", wish: "hand_over" }));
    const ask = (request: "start" | "stop" | "save" | "discard" | "home") => () =>
      connection.send({ type: "ask", request });
    if (description.guides) {
      const recording = status.recording === "recording";
      const waits = status.recording === "stopped";
      add(recording ? "Stop" : "Start", ask(recording ? "stop" : "start"), { disabled: waits });
      add("Replay", () => this.tape.play(performance.now()), {
        pressed: this.tape.playing,
        disabled: recording || this.tape.empty,
      });
      add("Save", ask("save"), { disabled: !waits });
      add("Discard", ask("discard"), { disabled: !waits });
      add("Next name", () => this.nextName(status.task), { disabled: taskNames().length < 2 });
      add("Back to start", ask("home"), { disabled: recording });
      add("Open", () => connection.send({ type: "gripper", width: description.opening }));
      add("Close", () => connection.send({ type: "gripper", width: 0 }));
    }
    if (description.draws) {
      add("Draw region", () => this.choose("region"), { pressed: this.mode === "region" });
      const active = !scene.active;
      const region = scene.drawn;
      if (region) {
        add("Active", () => connection.send({ type: "region", ...region, active }), {
          pressed: scene.active,
        });
      }
      add("Mark target", () => this.choose("target"), { pressed: this.mode === "target" });
    }
    if (description.guides) {
      const gain = GAINS[(GAINS.indexOf(this.settings.gain) + 1) % GAINS.length]!;
      add(`Hand moves ${this.settings.gain} : 1`, () => (this.settings.gain = gain));
      const turns = () => (this.settings.turns = !this.settings.turns);
      add("Fine turn", turns, { pressed: this.settings.turns });
    }
    add("Twin", () => (this.showTwin = !this.showTwin), { pressed: this.showTwin });
    if (this.renderer.xr.isPresenting) {
      add("Place the arm", () => this.choose("place"), { pressed: this.mode === "place" });
      add("See through", () => this.seeThrough(), { pressed: !this.solid });
    }
    return { ...this.words(), buttons };
  }

  private words(): { words: string; colour: string } {
    const { status, scene } = this.connection;
    const { recording, seconds, saved, note, doing, task, pushed } = status!;
    const lines = doing
      ? [`${doing}, ${seconds.toFixed(1)} s`]
      : [`${recording}${recording === "ready" ? "" : `, ${seconds.toFixed(1)} s`}; ${saved} saved`];
    if (this.description.guides) lines.push(task.trim() ? `Task: ${task}` : "The task has no name yet.");
    const tool = {
      lead: "",
      region: "Pinch and draw the region. Pinch inside to move it, at a corner to resize it.",
      target: "Pinch where the target is.",
      place: this.pointToTouch(),
    }[this.mode];
    lines.push(...[status!.words, note, tool || this.remark].filter(Boolean));
    const colour = pushed ? scene!.colour : recording === "recording" ? VERMILION : GREY;
    return { words: lines.join("\n"), colour };
  }

  private pointToTouch(): string {
    const done = this.touching.so_far;
    const [x, y, z] = this.description.touch_points[done]!.map((v) => Math.round(100 * v));
    return `Pinch at point ${done + 1} of ${this.description.touch_points.length}: x ${x}, y ${y}, z ${z} cm from the arm's base.`;
  }

  private nextName(task: string): void {
    const names = taskNames();
    this.name(names[(names.indexOf(task) + 1) % names.length] ?? task);
  }

  private seeThrough(): void {
    this.solid = !this.solid;
    this.arm.opacity = this.solid ? 1 : 0.35;
  }

  /** Positions of fingertips, and the bodies that they hold or would hold. */
  private cues(pointers: Pointer[]): void {
    const seen = new Set<HandName>();
    const lit = new Map<ArmView, number>();
    for (const pointer of pointers) {
      const cue = this.cue(pointer.hand);
      const held = this.holding.targets.get(pointer.hand);
      const target = this.mode === "lead" ? (held ?? this.holding.target(pointer)) : null;
      const over = this.panel.meet(pointer.ray) !== null && !held;
      if (target?.met && !over) lit.set(target.view, target.met.body);
      if (!pointer.position) continue;
      seen.add(pointer.hand);
      cue.ball.position.copy(pointer.position);
      (cue.ball.material as MeshBasicMaterial).color = new Color(held ? this.connection.scene!.colour : "#ffffff");
      cue.label.sprite.position.copy(pointer.position).add(new Vector3(0, 0.06, 0));
      const what = target?.met?.joint == null ? "end effector" : `link ${target.met.joint}`;
      const how = target?.how === "clutch" ? "leads the" : `${target?.view.manipulation}:`;
      cue.label.show(target && !over && (held || target.met) ? [`${how} ${what}`] : [], ORANGE);
    }
    for (const [hand, { ball, label }] of this.tips) {
      ball.visible = seen.has(hand);
      if (!ball.visible) label.sprite.visible = false;
    }
    for (const view of [this.arm, this.twin]) view.highlight(lit.get(view) ?? -1, ORANGE);
  }

  private cue(hand: HandName): { ball: Mesh; label: Label } {
    let cue = this.tips.get(hand);
    if (!cue) {
      const ball = new Mesh(new SphereGeometry(0.009, 16, 12), new MeshBasicMaterial());
      cue = { ball, label: new Label(0.022) };
      this.scene.add(ball, cue.label.sprite);
      this.tips.set(hand, cue);
    }
    return cue;
  }

  /** Feedback of the arm: pulses, and text above the end effector. */
  private feel(time: number): void {
    const { status, scene } = this.connection;
    if (!status || !scene) return;
    const lines = [...(status.pushed && status.followed < 0.9 ? status.reasons : []), ...status.felt];
    this.said.show(lines.slice(0, 4), scene.colour);
    const tool = scene.links.at(-1);
    if (tool) this.said.sprite.position.copy(this.arm.toWorld(tool)).add(new Vector3(0, 0.14, 0));
    const sources = this.renderer.xr.getSession()?.inputSources;
    if (sources && status.role === "leads") this.pulses.play(sources, status.pulse, time);
  }

  private stand(view: ArmView, matrix: Matrix4): void {
    view.group.matrix.copy(matrix);
    view.group.matrixWorldNeedsUpdate = true;
  }

  /** Show the workplace without a headset. */
  private frameWorkplace(): void {
    this.stand(this.arm, placementMatrix(this.placing.arm));
    this.arm.group.updateMatrixWorld(true);
    const back = Math.max(1, 1.2 / this.camera.aspect);
    this.orbit.target.copy(this.arm.toWorld([0.2, 0.3, 0.25]));
    this.camera.position.copy(this.arm.toWorld([0.2 + 2.0 * back, 0.3 + 0.5 * back, 0.25 + 0.7 * back]));
    this.orbit.update();
  }

  private resize(): void {
    if (this.renderer.xr.isPresenting) return;
    this.camera.aspect = innerWidth / innerHeight;
    this.camera.fov = 50;
    this.camera.updateProjectionMatrix();
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(innerWidth, innerHeight, false);
  }
}

const TASKS = "hrc-tasks";
function taskNames(): string[] {
  try {
    return JSON.parse(localStorage.getItem(TASKS) ?? "[]");
  } catch {
    return [];
  }
}

const modes: { mode: XRSessionMode; label: string }[] = [];
async function findModes(): Promise<void> {
  for (const [mode, label] of [
    ["immersive-ar", "Enter AR"],
    ["immersive-vr", "Enter VR"],
  ] as const) {
    if (await navigator.xr?.isSessionSupported(mode).catch(() => false)) modes.push({ mode, label });
  }
}

async function main(): Promise<void> {
  const words = document.getElementById("words")!;
  try {
    const [description, model] = await Promise.all([
      fetch("/xr/scene.json").then((answer) => answer.json() as Promise<Description>),
      new GLTFLoader().loadAsync("/xr/scene.glb"),
      findModes(),
    ]);
    const canvas = document.getElementById("view") as HTMLCanvasElement;
    new Client(canvas, description, model.scene);
  } catch (error) {
    words.textContent = `The arm cannot be shown: ${error}`;
    throw error;
  }
}

void main();
