"use strict";
// The page of `hrc curate`, on which a person views, plays and judges the ranked episodes.

const SERIES = ["#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#9AA0A6", "#8c564b"];
const AHEAD = 3; // blocks of images fetched before they are shown
const KEPT = 12; // blocks of each camera that are kept
const byId = (id) => document.getElementById(id);
const colour = (name) => getComputedStyle(document.body).getPropertyValue(name).trim();

let overview = null; // content of /data/overview
let order = []; // episodes in the order of the list
let current = null; // the episode shown
let curves = null; // its curves
let usual = null; // the curves of the most usual episode
let frame = 0;
let playing = false;
let marks = { start: 0, stop: 0 }; // first and last frame of a cut that is not yet decided
let blocks = new Map(); // "camera:number" -> promise of images

async function ask(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}
const get = async (path) => (await ask(path)).json();

// Send one message to the program, and return the state in its answer.
const tell = (message) =>
  new Promise((resolve, reject) => {
    const { url, protocols } = hrcDoor.socket("session");
    const socket = new WebSocket(url, protocols);
    socket.onopen = () => socket.send(JSON.stringify(message));
    socket.onmessage = ({ data }) => {
      const told = JSON.parse(data);
      if (told.refused) reject(new Error(told.refused));
      else resolve(told);
      socket.close();
    };
    socket.onclose = ({ reason }) => reject(new Error(reason || "The program does not answer."));
  });

function say(words, failed = false) {
  const box = byId("said");
  box.hidden = !words;
  box.textContent = words;
  box.classList.toggle("failed", failed);
}

// The list of episodes, and their map.

const verdict = (episode) => overview.decisions[episode]?.verdict ?? "";

function sorted() {
  const by = byId("sort").value;
  const key = {
    score: (e) => [-e.score, e.episode],
    episode: (e) => [e.episode, 0],
  }[by] ?? ((e) => [-(e.measures[by] ?? -1e9), e.episode]); // the largest first
  const open = byId("open").checked;
  return overview.episodes
    .filter((e) => !open || !verdict(e.episode) || e === current)
    .sort((a, b) => key(a)[0] - key(b)[0] || key(a)[1] - key(b)[1]);
}

// The measure that the list is sorted by.
function said_of(episode) {
  const by = byId("sort").value;
  const value = episode.measures[by];
  return value === undefined || value === null ? "" : `${by} ${value.toPrecision(3)}: `;
}

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function list() {
  order = sorted();
  const most = Math.max(...overview.episodes.map((e) => e.score), 1);
  const items = order.map((e) => {
    const bar = element("span", { className: "doubt", title: `doubt ${e.score.toFixed(1)}` });
    bar.append(element("i", { style: `width:${(100 * e.score) / most}%` }));
    const said = verdict(e.episode);
    const button = element(
      "button",
      { onclick: () => choose(e) },
      element("b", { textContent: `Episode ${e.episode}` }),
      bar,
      element("span", { className: `badge ${said}`, textContent: said }),
      element("span", {
        className: "why",
        textContent: said_of(e) + (e.reasons.join("; ") || "no reason for doubt"),
      }),
    );
    const item = element("li", {}, button);
    if (e === current) item.setAttribute("aria-current", "true");
    return item;
  });
  byId("episodes").replaceChildren(...items);
  const counts = { accept: 0, cut: 0, reject: 0 };
  for (const d of Object.values(overview.decisions)) counts[d.verdict] += 1;
  const left = overview.episodes.length - counts.accept - counts.cut - counts.reject;
  byId("counts").textContent =
    `${overview.episodes.length} episodes: ${counts.accept} accepted, ${counts.cut} cut, ` +
    `${counts.reject} rejected, ${left} undecided (they stay)`;
  drawMap();
}

function canvasOf(canvas) {
  const scale = window.devicePixelRatio || 1;
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(w * scale) || canvas.height !== Math.round(h * scale)) {
    canvas.width = Math.round(w * scale);
    canvas.height = Math.round(h * scale);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, w, h);
  return [pen, w, h];
}

function mapPlaces(w, h) {
  const placed = overview.episodes.filter((e) => e.place);
  const range = (i) => {
    const values = placed.map((e) => e.place[i]);
    return [Math.min(...values), Math.max(...values)];
  };
  if (!placed.length) return [];
  const [x, y] = [range(0), range(1)];
  const at = (v, [low, high], size) => 10 + ((size - 20) * (v - low)) / (high - low || 1);
  return placed.map((e) => [e, at(e.place[0], x, w), at(e.place[1], y, h)]);
}

function drawMap() {
  const canvas = document.querySelector("#map canvas");
  const [pen, w, h] = canvasOf(canvas);
  byId("map").hidden = !overview.episodes.some((e) => e.place);
  for (const [e, x, y] of mapPlaces(w, h)) {
    pen.beginPath();
    pen.arc(x, y, e === current ? 6 : 3.5, 0, 7);
    pen.fillStyle = e.score > 0 ? SERIES[1] : colour("--faint");
    pen.fill();
    if (e === current) {
      pen.lineWidth = 2;
      pen.strokeStyle = colour("--ink");
      pen.stroke();
    }
  }
}

document.querySelector("#map canvas").onclick = (event) => {
  const canvas = event.target;
  const box = canvas.getBoundingClientRect();
  let best = null;
  for (const [e, x, y] of mapPlaces(canvas.clientWidth, canvas.clientHeight)) {
    const off = Math.hypot(x - event.clientX + box.left, y - event.clientY + box.top);
    if (off < 20 && (!best || off < best[1])) best = [e, off];
  }
  if (best) choose(best[0]);
};

// One episode.

async function choose(episode) {
  current = episode;
  blocks = new Map();
  frame = 0;
  curves = null;
  const decided = overview.decisions[episode.episode];
  const motion = { start: episode.start, stop: episode.stop };
  marks = decided?.verdict === "cut" ? { start: decided.start, stop: decided.stop } : motion;
  byId("title").textContent = `Episode ${episode.episode}`;
  byId("task").textContent = `${episode.task} (${episode.length} frames)`;
  const reasons = episode.reasons.length ? episode.reasons : ["No reason for doubt."];
  byId("reasons").className = episode.reasons.length ? "" : "none";
  byId("reasons").replaceChildren(
    ...reasons.map((text) => element("li", { textContent: text })),
  );
  byId("slider").max = episode.length - 1;
  byId("videos").replaceChildren(
    ...episode.cameras.map((camera) => {
      const canvas = element("canvas", { width: 480, height: 360 });
      canvas.dataset.camera = camera;
      const label = element("figcaption", { textContent: overview.cameras[camera] });
      return element("figure", {}, canvas, label);
    }),
  );
  byId("charts").replaceChildren();
  list();
  document.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest", inline: "nearest" });
  show();
  try {
    const found = await get(`/data/curves/${episode.episode}`);
    if (current !== episode) return;
    curves = found;
    if (overview.usual !== null && usual === null) {
      usual = await get(`/data/curves/${overview.usual}`).catch(() => false);
    }
    if (current === episode) charts();
  } catch (error) {
    if (current === episode) {
      byId("charts").textContent = `Its curves cannot be shown: ${error.message}`;
    }
  }
}

function block(camera, number) {
  const key = `${camera}:${number}`;
  if (!blocks.has(key)) {
    const own = blocks;
    const path = `/data/images/${current.episode}/${camera}/${number * overview.block}`;
    own.set(key, images(path));
    const kept = [...own.keys()].filter((k) => k.startsWith(`${camera}:`));
    for (const old of kept.slice(0, Math.max(0, kept.length - KEPT))) own.delete(old);
  }
  return blocks.get(key);
}

async function images(path) {
  const bytes = await (await ask(path)).arrayBuffer();
  const view = new DataView(bytes);
  const count = view.getUint32(0, true);
  const found = [];
  let at = 4 * (count + 1);
  for (let i = 0; i < count; i += 1) {
    const length = view.getUint32(4 * (i + 1), true);
    const part = new Blob([bytes.slice(at, at + length)], { type: "image/jpeg" });
    found.push(createImageBitmap(part));
    at += length;
  }
  return Promise.all(found);
}

async function showImages() {
  const [episode, shown] = [current, frame];
  const number = Math.floor(shown / overview.block);
  const last = Math.floor((episode.length - 1) / overview.block);
  const waiting = [...document.querySelectorAll("#videos canvas[data-camera]")].map(async (canvas) => {
    try {
      const found = await block(canvas.dataset.camera, number);
      for (let i = 1; i <= AHEAD && number + i <= last; i += 1) {
        if (playing || i === 1) block(canvas.dataset.camera, number + i).catch(() => null);
      }
      if (current !== episode || frame !== shown) return;
      const image = found[shown % overview.block];
      if (!image) return;
      canvas.width = image.width;
      canvas.height = image.height;
      canvas.getContext("2d").drawImage(image, 0, 0);
      canvas.dataset.frame = shown;
    } catch (error) {
      canvas.nextSibling.textContent = error.message;
    }
  });
  await Promise.all(waiting);
}

function show() {
  byId("slider").value = frame;
  const time = curves ? curves.time[frame] : null;
  byId("clock").value = `${frame} / ${current.length - 1}` + (time === null ? "" : `, ${time.toFixed(2)} s`);
  const part = (value) => (100 * value) / current.length;
  byId("kept").style.left = `${part(marks.start)}%`;
  byId("kept").style.width = `${part(marks.stop - marks.start)}%`;
  byId("play").innerHTML = playing ? "&#10073;&#10073;" : "&#9654;";
  byId("play").setAttribute("aria-label", playing ? "Pause" : "Play");
  for (const button of document.querySelectorAll("[data-verdict]")) {
    button.setAttribute("aria-pressed", verdict(current.episode) === button.dataset.verdict);
  }
  document.querySelector("[data-verdict=cut]").textContent = `Cut to ${marks.start} - ${marks.stop}`;
  for (const canvas of document.querySelectorAll("#charts canvas")) drawChart(canvas);
  return showImages();
}

// Curves.

function charts() {
  byId("legend").hidden = false;
  byId("usual").textContent = usual ? `Thin grey: episode ${overview.usual}, the most usual one. ` : "";
  byId("charts").replaceChildren(
    ...curves.charts.map((chart, index) => {
      const canvas = element("canvas");
      canvas.dataset.chart = index;
      canvas.onpointerdown = canvas.onpointermove = (event) => {
        if (!event.buttons) return;
        const box = canvas.getBoundingClientRect();
        const share = Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1);
        seek(Math.round(share * (current.length - 1)));
      };
      const unit = chart.unit ? ` [${chart.unit}]` : "";
      const legend = element("figcaption", { textContent: chart.name + unit });
      chart.lines.forEach((line, i) => {
        if (chart.lines.length > 1) {
          const swatch = element("i", { className: "swatch" });
          swatch.style.background = lineColour(chart, i);
          legend.append(element("span", {}, swatch, line.name));
        }
      });
      return element("figure", {}, canvas, legend);
    }),
  );
  show();
}

const lineColour = (chart, i) =>
  chart.lines.length <= 2 ? colour(i ? "--command" : "--state") : SERIES[i % SERIES.length];

function drawChart(canvas) {
  const chart = curves?.charts[canvas.dataset.chart];
  if (!chart) return;
  const [pen, w, h] = canvasOf(canvas);
  const other = usual && usual.charts.find((c) => c.name === chart.name);
  const values = chart.lines.flatMap((line) => line.points[1]);
  const all = (other ? values.concat(other.lines[0].points[1]) : values).filter((v) => v !== null);
  let [low, high] = [Infinity, -Infinity];
  for (const v of all) {
    if (v < low) low = v;
    if (v > high) high = v;
  }
  const y = (v) => h - 16 - ((h - 32) * (v - low)) / (high - low || 1);
  const stroke = (line, count, style, width) => {
    const [frames, points] = line.points;
    pen.beginPath();
    frames.forEach((f, i) => {
      if (points[i] !== null) pen.lineTo((w * f) / Math.max(count - 1, 1), y(points[i]));
    });
    pen.strokeStyle = style;
    pen.lineWidth = width;
    pen.stroke();
  };
  if (other) stroke(other.lines[0], usual.time.length, colour("--usual"), 1);
  chart.lines.forEach((line, i) => stroke(line, current.length, lineColour(chart, i), 1.6));
  pen.fillStyle = colour("--outside");
  pen.fillRect(0, 0, (w * marks.start) / current.length, h);
  const end = (w * marks.stop) / current.length;
  pen.fillRect(end, 0, w - end, h);
  pen.fillStyle = colour("--ink");
  pen.fillRect((w * frame) / Math.max(current.length - 1, 1) - 0.5, 0, 1, h);
  pen.fillStyle = colour("--faint");
  pen.font = "10px system-ui, sans-serif";
  pen.fillText(high.toPrecision(3), 3, 11);
  pen.fillText(low.toPrecision(3), 3, h - 3);
}

// Playing: at the rate of the clock, and no faster than images arrive.

function seek(to) {
  frame = Math.min(Math.max(to, 0), current.length - 1);
  return show();
}

async function play() {
  if (playing) {
    playing = false;
    show();
    return;
  }
  playing = true;
  const episode = current;
  if (frame >= episode.length - 1) frame = 0;
  let [began, from] = [performance.now(), frame];
  while (playing && current === episode && frame < episode.length - 1) {
    await new Promise(requestAnimationFrame);
    const speed = Number(byId("speed").value);
    const times = curves ? curves.time : null;
    const elapsed = (speed * (performance.now() - began)) / 1e3;
    let next = frame;
    if (times) while (next < episode.length - 1 && times[next] - times[from] < elapsed) next += 1;
    if (next === frame) continue;
    frame = next;
    const before = performance.now();
    await show();
    // Time spent waiting for images is not part of the demonstration.
    if (performance.now() - before > 200) [began, from] = [performance.now(), frame];
  }
  playing = false;
  if (current === episode) show();
}

// Decisions.

async function decide(verdict) {
  const episode = current;
  const undo = overview.decisions[episode.episode]?.verdict === verdict && verdict !== "cut";
  const cut = verdict === "cut" ? marks : {};
  const said = { episode: episode.episode, verdict: undo ? null : verdict, ...cut };
  try {
    Object.assign(overview, await tell({ type: "decide", ...said }));
    say("");
  } catch (error) {
    say(error.message, true);
    return;
  }
  const next = order[order.indexOf(episode) + 1];
  if (!undo && verdict !== "cut" && next) choose(next);
  else {
    list();
    show();
  }
}

async function write() {
  byId("write").disabled = true;
  try {
    let state = await tell({ type: "write" });
    say("Writing ...");
    while (state.written.writing) {
      await new Promise((done) => setTimeout(done, 300));
      state = await get("/data/state");
    }
    say(state.written.said, state.written.failed);
  } catch (error) {
    say(error.message, true);
  }
  byId("write").disabled = false;
}

function step(by) {
  const next = order[order.indexOf(current) + by];
  if (next) choose(next);
}

byId("sort").onchange = byId("open").onchange = list;
byId("slider").oninput = (event) => seek(Number(event.target.value));
byId("play").onclick = play;
byId("write").onclick = write;
byId("from").onclick = () => {
  marks.start = frame;
  if (marks.stop < marks.start + 2) marks.stop = current.length;
  show();
};
byId("to").onclick = () => {
  marks.stop = frame + 1;
  if (marks.start > marks.stop - 2) marks.start = 0;
  show();
};
for (const button of document.querySelectorAll("[data-verdict]")) {
  button.onclick = () => decide(button.dataset.verdict);
}
const KEYS = {
  " ": play,
  a: () => decide("accept"),
  c: () => decide("cut"),
  x: () => decide("reject"),
  "[": () => byId("from").click(),
  "]": () => byId("to").click(),
  j: () => step(1),
  k: () => step(-1),
  ArrowRight: () => seek(frame + 1),
  ArrowLeft: () => seek(frame - 1),
};
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select")) return;
  if (event.key.startsWith("Arrow") && event.target.matches("input[type=range]")) return;
  if (event.key === " " && event.target.matches("button, input")) return;
  if (current && KEYS[event.key]) {
    event.preventDefault();
    KEYS[event.key]();
  }
});
window.addEventListener("resize", () => current && (drawMap(), show()));

get("/data/overview").then(
  (found) => {
    overview = found;
    byId("name").textContent = overview.name;
    document.title = `${overview.name} - hrc curate`;
    byId("write").title = `Into ${overview.written.out}`;
    say(overview.notes.join("; "), overview.notes.length > 0);
    choose(sorted()[0]);
  },
  (error) => say(error.message, true),
);
