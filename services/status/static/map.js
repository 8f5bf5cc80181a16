// The map: a canvas with a view that is panned, zoomed and follows the robot; reads out what lies under the cursor.

import { COVERAGE_WORDS, coverageTable, drawDraft, drawLayers, riskTable } from "./layers.js";

const MIN_SCALE = 0.3, MAX_SCALE = 200; // pixels a metre
const STEP_PX = 60;

export class MapView {
  constructor(canvas, store, onChange) {
    Object.assign(this, { canvas, store, onChange });
    this.context = canvas.getContext("2d");
    this.cx = this.cy = 0;
    this.scale = 12;
    this.follow = true;
    this.shown = {};
    this.fences = [];
    this.draft = null;
    this.pointer = null; // pixels, null: not over the map
    this.images = new Map();
    this.riskCanvas = document.createElement("canvas");
    this.frameMs = [];
    this.drawn = 0;
    this.firstMapAt = null; // performance.now() of the first frame with something on it
    this.readColours();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.readColours());
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.listen();
    this.resize();
  }

  readColours() {
    const style = getComputedStyle(document.documentElement);
    const names = ["ground", "toCover", "covered", "obstacle", "outOfReach", "riskLow", "riskHigh", "lethal", "local",
      "graph", "frontier", "policy", "target", "trail", "oldPath", "newPath", "keptPath", "doubt", "robot", "stale",
      "halo", "geofence", "noGo", "priority", "text"];
    const variable = (name) => "--map-" + name.replace(/[A-Z]/g, (c) => "-" + c.toLowerCase());
    this.colours = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(variable(name)).trim()]));
    this.riskTable = riskTable(this.colours);
    this.coverageTable = coverageTable(this.colours);
    this.images.clear();
    for (const key of this.store.parts.keys()) if (key.startsWith("cov:")) this.store.tilesChanged.add(key);
    this.store.memos?.delete("riskImage");
    this.hatches = {};
    this.redraw();
  }

  resize() {
    const ratio = devicePixelRatio || 1, box = this.canvas.getBoundingClientRect();
    this.width = Math.max(box.width, 1);
    this.height = Math.max(box.height, 1);
    this.ratio = ratio;
    this.canvas.width = Math.round(this.width * ratio);
    this.canvas.height = Math.round(this.height * ratio);
    this.redraw();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = 0;
      this.draw();
    });
  }

  // --- frames ---

  screen(x, y) {
    return [this.width / 2 + (x - this.cx) * this.scale, this.height / 2 - (y - this.cy) * this.scale];
  }

  world(px, py) {
    return [this.cx + (px - this.width / 2) / this.scale, this.cy - (py - this.height / 2) / this.scale];
  }

  inScreen() {
    this.context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
  }

  inMap() {
    const s = this.scale * this.ratio;
    this.context.setTransform(s, 0, 0, -s, (this.width / 2) * this.ratio - this.cx * s,
      (this.height / 2) * this.ratio + this.cy * s);
  }

  inOdom() {
    this.inMap();
    const frame = this.store.get("pose")?.frame;
    if (!frame) return;
    this.context.translate(frame[0], frame[1]);
    this.context.rotate(frame[2]);
  }

  inFrame(frame) {
    if (frame === "odom") this.inOdom();
    else this.inMap();
  }

  toOdom(x, y) {
    const [fx, fy, yaw] = this.store.get("pose")?.frame ?? [0, 0, 0];
    const c = Math.cos(yaw), s = Math.sin(yaw);
    return [c * (x - fx) + s * (y - fy), -s * (x - fx) + c * (y - fy)];
  }

  outside(x, y, w, h) {
    const [left, top] = this.world(0, 0), [right, bottom] = this.world(this.width, this.height);
    return x > right || x + w < left || y > top || y + h < bottom;
  }

  topicStale(name) {
    return this.store.topic(name)?.stale ?? false;
  }

  // Lines across: told apart from other areas without colour.
  hatch(kind) {
    return (this.hatches[kind] ??= this.makeHatch(kind));
  }

  makeHatch(kind) {
    const tile = document.createElement("canvas");
    tile.width = tile.height = 12;
    const context = tile.getContext("2d");
    context.strokeStyle = kind === "priority" ? this.colours.priority : this.colours.noGo;
    context.globalAlpha = 0.55;
    context.lineWidth = 2;
    context.beginPath();
    if (kind === "priority") context.arc(6, 6, 1.2, 0, 7);
    else [-6, 6].forEach((x) => { context.moveTo(x, 12); context.lineTo(x + 12, 0); });
    context.stroke();
    const pattern = this.context.createPattern(tile, "repeat");
    return pattern;
  }

  // --- drawing ---

  draw() {
    const began = performance.now();
    const pose = this.store.get("pose");
    if (this.follow && pose) [this.cx, this.cy] = [pose.x, pose.y];
    this.inScreen();
    this.context.imageSmoothingEnabled = false;
    this.context.fillStyle = this.colours.ground;
    this.context.fillRect(0, 0, this.width, this.height);
    for (const hatch of Object.values(this.hatches))
      hatch.setTransform(new DOMMatrix().scale(1 / this.scale, -1 / this.scale));
    drawLayers(this, this.shown);
    if (this.draft) drawDraft(this, this.draft);
    this.drawScaleBar();
    if (this.keyboard) this.drawCrosshair();
    this.drawn += 1;
    if (this.firstMapAt === null && this.images.size) this.firstMapAt = performance.now();
    this.frameMs.push(performance.now() - began);
    if (this.frameMs.length > 300) this.frameMs.shift();
  }

  // Times of n frames in ms, every one drawn anew from another place and finished before the next one begins.
  measure(n) {
    const times = [];
    for (let i = 0; i < n; i++) {
      this.follow = false;
      this.cx += 0.37;
      const began = performance.now();
      this.draw();
      this.context.getImageData(0, 0, 1, 1);
      times.push(performance.now() - began);
    }
    return times;
  }

  drawScaleBar() {
    const { context, colours } = this;
    const raw = 110 / this.scale, power = 10 ** Math.floor(Math.log10(raw));
    const metres = [5, 2, 1].map((n) => n * power).find((n) => n <= raw) ?? power;
    const length = metres * this.scale, x = 12, y = this.height - 14;
    this.inScreen();
    context.lineWidth = 5;
    context.strokeStyle = colours.halo;
    const bar = () => {
      context.beginPath();
      context.moveTo(x, y - 6);
      context.lineTo(x, y);
      context.lineTo(x + length, y);
      context.lineTo(x + length, y - 6);
      context.stroke();
    };
    bar();
    context.lineWidth = 2;
    context.strokeStyle = colours.text;
    bar();
    const words = metres >= 1 ? `${metres} m` : `${Math.round(metres * 100)} cm`;
    context.font = "600 13px system-ui, sans-serif";
    context.lineWidth = 4;
    context.strokeStyle = colours.halo;
    context.strokeText(words, x + 6, y - 8);
    context.fillStyle = colours.text;
    context.fillText(words, x + 6, y - 8);
    this.scaleBar = { metres, pixels: length };
  }

  drawCrosshair() {
    const { context } = this, x = this.width / 2, y = this.height / 2;
    context.beginPath();
    context.moveTo(x - 12, y);
    context.lineTo(x + 12, y);
    context.moveTo(x, y - 12);
    context.lineTo(x, y + 12);
    context.lineWidth = 1.5;
    context.strokeStyle = this.colours.text;
    context.stroke();
  }

  // --- what lies where ---

  // The place under the pointer, or in the middle while the map is steered by keys.
  readOut() {
    const at = this.pointer ?? (this.keyboard ? [this.width / 2, this.height / 2] : null);
    if (!at) return null;
    const [x, y] = this.world(...at);
    return { frame: "map", x, y, risk: this.riskAt(x, y), coverage: this.coverageAt(x, y) };
  }

  riskAt(x, y) {
    const part = this.store.get("risk");
    if (!part) return "unknown";
    const [ox, oy] = this.toOdom(x, y);
    const column = Math.floor(ox / part.res) - part.ix0, row = Math.floor(oy / part.res) - part.iy0;
    if (column < 0 || row < 0 || column >= part.w || row >= part.h) return "out of the window";
    const code = part.cells[row * part.w + column];
    if (code === 0) return "unknown";
    if (code === 255) return "lethal";
    return `${(part.full_per_m * ((code - 1) / 253) ** 2).toFixed(3)} /m`;
  }

  coverageAt(x, y) {
    for (const key of this.images.keys()) {
      const part = this.store.get(key);
      if (!part) continue;
      const column = Math.floor(x / part.res) - part.tx * part.side;
      const row = Math.floor(y / part.res) - part.ty * part.side;
      if (column >= 0 && row >= 0 && column < part.side && row < part.side)
        return COVERAGE_WORDS[part.cells[row * part.side + column]];
    }
    return "unknown";
  }

  // --- moving about ---

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const scale = Math.min(MAX_SCALE, Math.max(MIN_SCALE, this.scale * factor));
    if (!this.follow) {
      const [x, y] = this.world(px, py);
      this.cx = x - (px - this.width / 2) / scale;
      this.cy = y + (py - this.height / 2) / scale;
    }
    this.scale = scale;
    this.moved();
  }

  pan(dx, dy) {
    this.follow = false;
    this.cx -= dx / this.scale;
    this.cy += dy / this.scale;
    this.moved();
  }

  setFollow(follow) {
    this.follow = follow;
    this.moved();
  }

  // Everything that is known, in sight.
  fit() {
    let [x0, y0, x1, y1] = [Infinity, Infinity, -Infinity, -Infinity];
    const take = (x, y) => {
      [x0, y0, x1, y1] = [Math.min(x0, x), Math.min(y0, y), Math.max(x1, x), Math.max(y1, y)];
    };
    const graph = this.store.graph();
    for (let i = 0; i < graph.x.length; i++) take(graph.x[i], graph.y[i]);
    for (const xy of this.store.trail()) for (let i = 0; i < xy.length; i += 2) take(xy[i], xy[i + 1]);
    if (x0 > x1) return;
    this.follow = false;
    [this.cx, this.cy] = [(x0 + x1) / 2, (y0 + y1) / 2];
    const room = 14;
    this.scale = Math.min(this.width / (x1 - x0 + room), this.height / (y1 - y0 + room), 40);
    this.scale = Math.max(this.scale, MIN_SCALE);
    this.moved();
  }

  moved() {
    this.redraw();
    this.onChange();
  }

  listen() {
    const { canvas } = this;
    this.touches = new Map();
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.up(event));
    canvas.addEventListener("pointerleave", () => this.leave());
    canvas.addEventListener("dblclick", () => this.draft && this.onFinish?.());
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("focus", () => this.setKeyboard(canvas.matches(":focus-visible")));
    canvas.addEventListener("blur", () => this.setKeyboard(false));
  }

  setKeyboard(keyboard) {
    this.keyboard = keyboard;
    this.moved();
  }

  down(event) {
    try {
      this.canvas.setPointerCapture(event.pointerId);
    } catch {
      // a pointer that has gone already
    }
    this.touches.set(event.pointerId, [event.offsetX, event.offsetY]);
    this.pressed = { at: [event.offsetX, event.offsetY], moved: false };
  }

  move(event) {
    const here = [event.offsetX, event.offsetY], before = this.touches.get(event.pointerId);
    this.pointer = here;
    if (this.draft) this.draft.cursor = this.world(...here);
    if (before && this.touches.size === 1) this.drag(here, before);
    else if (before && this.touches.size === 2) this.pinch(event.pointerId, here, before);
    if (before) this.touches.set(event.pointerId, here);
    this.moved();
  }

  drag(here, before) {
    if (Math.hypot(here[0] - this.pressed.at[0], here[1] - this.pressed.at[1]) > 5) this.pressed.moved = true;
    if (this.pressed.moved) this.pan(here[0] - before[0], here[1] - before[1]);
  }

  pinch(id, here, before) {
    this.pressed.moved = true;
    const [other] = [...this.touches].filter(([key]) => key !== id).map(([, place]) => place);
    const was = Math.hypot(before[0] - other[0], before[1] - other[1]);
    const is = Math.hypot(here[0] - other[0], here[1] - other[1]);
    if (was > 10) this.zoom(is / was, (here[0] + other[0]) / 2, (here[1] + other[1]) / 2);
  }

  up(event) {
    this.touches.delete(event.pointerId);
    if (event.type === "pointerup" && this.draft && this.pressed && !this.pressed.moved)
      this.addPoint(this.world(event.offsetX, event.offsetY));
    if (event.pointerType !== "mouse") this.leave();
  }

  leave() {
    this.pointer = null;
    if (this.draft) this.draft.cursor = null;
    this.moved();
  }

  // A second click on the last point (a double click) adds nothing.
  addPoint(point) {
    const { points } = this.draft, last = points[points.length - 1];
    if (last && Math.hypot(last[0] - point[0], last[1] - point[1]) * this.scale < 4) return;
    points.push(point);
    this.moved();
  }

  key(event) {
    const moves = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const step = moves[event.key];
    this.keyboard = true;
    this.pointer = null;
    if (step) this.pan(step[0] * STEP_PX, step[1] * STEP_PX);
    else if (event.key === "+" || event.key === "=") this.zoom(1.25);
    else if (event.key === "-") this.zoom(0.8);
    else if (event.key === "f") this.setFollow(!this.follow);
    else if (event.key === "0") this.fit();
    else if (this.draft && event.key === " ") this.addPoint([this.cx, this.cy]);
    else if (this.draft && event.key === "Enter") this.onFinish?.();
    else if (this.draft && event.key === "Backspace") this.draft.points.pop();
    else if (this.draft && event.key === "Escape") this.onCancel?.();
    else return;
    event.preventDefault();
    this.moved();
  }
}
