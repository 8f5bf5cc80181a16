// What the map draws, one function a layer. `at` is the frame of drawing: context, view, store, colours, time.

import { numbers } from "./store.js";

export const LAYERS = [
  // key, name, shown at first, topic whose age counts
  ["coverage", "Coverage", true, "irm/coverage_window"],
  ["risk", "Risk", true, "riskmap/risk_map"],
  ["local", "Local IRM", false, "irm/local_irm"],
  ["graph", "Global IRM", true, "irm/global_irm"],
  ["policy", "Policy arrows", false, "gcp/global_policy"],
  ["target", "Target and way", true, "gcp/global_policy"],
  ["trail", "Driven way", true, "sim/odometry"],
  ["old", "Old path", true, "reconciler/plan"],
  ["plan", "New path", true, "reconciler/plan"],
  ["fences", "Fences", true, null],
  ["pose", "Pose and its doubt", true, "sim/odometry"],
];

export const COVERAGE_WORDS = ["unknown", "to cover", "covered", "obstacle", "out of reach"];
const CONFIDENCE_95 = Math.sqrt(5.991);

function rgba(text) {
  const hex = text.trim().replace("#", "");
  const value = parseInt(hex.slice(0, 6), 16);
  return [value >> 16, (value >> 8) & 255, value & 255];
}

function packed([r, g, b], alpha = 255) {
  return ((alpha << 24) | (b << 16) | (g << 8) | r) >>> 0;
}

// 256 colours of the risk: clear where unknown, from faint to strong, lethal apart from all.
export function riskTable(colours) {
  const table = new Uint32Array(256);
  const low = rgba(colours.riskLow), high = rgba(colours.riskHigh);
  for (let i = 1; i < 255; i++) {
    const share = (i - 1) / 253;
    const mixed = low.map((value, k) => Math.round(value + (high[k] - value) * share));
    table[i] = packed(mixed, Math.round(20 + 215 * share));
  }
  table[255] = packed(rgba(colours.lethal), 235);
  return table;
}

export function coverageTable(colours) {
  const table = new Uint32Array(256);
  ["toCover", "covered", "obstacle", "outOfReach"].forEach((name, i) => {
    table[i + 1] = packed(rgba(colours[name]));
  });
  return table;
}

// Cells as a small canvas, one pixel a cell, row 0 (the lowest y) first.
export function cellImage(cells, width, height, table, canvas) {
  canvas ??= document.createElement("canvas");
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  const image = context.createImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  for (let i = 0; i < cells.length; i++) pixels[i] = table[cells[i]];
  context.putImageData(image, 0, 0);
  return canvas;
}

export function drawCoverage(at) {
  const { context, store, images } = at;
  for (const key of store.tilesChanged) {
    const part = store.get(key);
    if (part) images.set(key, cellImage(part.cells, part.side, part.side, at.coverageTable, images.get(key)));
    else images.delete(key);
  }
  store.tilesChanged.clear();
  at.inMap();
  for (const [key, image] of images) {
    const part = store.get(key);
    if (!part) continue;
    const side = part.side * part.res;
    if (at.outside(part.tx * side, part.ty * side, side, side)) continue;
    context.drawImage(image, part.tx * side, part.ty * side, side, side);
  }
}

export function drawRisk(at) {
  const { context, store } = at;
  const part = store.get("risk");
  if (!part) return;
  at.riskImage = store.memo("riskImage", ["risk"], () =>
    cellImage(part.cells, part.w, part.h, at.riskTable, at.riskCanvas));
  at.inOdom();
  if (at.topicStale("riskmap/risk_map")) context.globalAlpha = 0.3;
  const r = part.res;
  context.drawImage(at.riskImage, part.ix0 * r, part.iy0 * r, part.w * r, part.h * r);
  context.globalAlpha = 1;
}

export function drawLocal(at) {
  const { context, store, colours } = at;
  const part = store.get("local");
  if (!part) return;
  const local = store.memo("local", ["local"], () => {
    const xy = numbers(part.xy, "f4"), coverage = numbers(part.coverage, "f4");
    const pairs = numbers(part.edges, xy.length / 2 < 65536 ? "u2" : "u4");
    const path = new Path2D();
    for (let i = 0; i < pairs.length; i += 2) {
      path.moveTo(xy[2 * pairs[i]], xy[2 * pairs[i] + 1]);
      path.lineTo(xy[2 * pairs[i + 1]], xy[2 * pairs[i + 1] + 1]);
    }
    return { xy, coverage, path };
  });
  at.inOdom();
  context.lineWidth = 1 / at.scale;
  context.strokeStyle = colours.local;
  context.globalAlpha = 0.45;
  context.stroke(local.path);
  context.globalAlpha = 1;
  const half = Math.max(0.12, 1.6 / at.scale);
  const done = new Path2D(), open = new Path2D();
  for (let i = 0; i < local.coverage.length; i++) {
    const path = local.coverage[i] > 0.8 ? done : open;
    path.rect(local.xy[2 * i] - half, local.xy[2 * i + 1] - half, 2 * half, 2 * half);
  }
  context.fillStyle = colours.local;
  context.fill(done);
  context.stroke(open);
}

export function drawGraph(at) {
  const { context, store, colours } = at;
  const graph = store.graph();
  const paths = store.memo("graphPaths", ["graph"], () => edgePaths(graph));
  at.inMap();
  context.strokeStyle = colours.graph;
  context.lineWidth = 1 / at.scale;
  context.stroke(paths.seen);
  context.lineWidth = 1.8 / at.scale;
  context.stroke(paths.driven);
  at.inScreen();
  const size = Math.min(5, Math.max(2, at.scale * 0.35));
  context.fillStyle = colours.graph;
  context.beginPath();
  for (let i = 0; i < graph.x.length; i++) {
    if (graph.kind[i]) continue;
    const [x, y] = at.screen(graph.x[i], graph.y[i]);
    if (x > -9 && y > -9 && x < at.width + 9 && y < at.height + 9) context.rect(x - size / 2, y - size / 2, size, size);
  }
  context.fill();
  drawFrontiers(at, graph);
}

// Frontiers are diamonds, the larger the more they promise.
function drawFrontiers(at, graph) {
  const { context, colours } = at;
  context.beginPath();
  for (let i = 0; i < graph.x.length; i++) {
    if (!graph.kind[i]) continue;
    const [x, y] = at.screen(graph.x[i], graph.y[i]);
    if (x < -20 || y < -20 || x > at.width + 20 || y > at.height + 20) continue;
    const r = Math.min(11, 5 + Math.sqrt(graph.gain[i]) * 0.6);
    context.moveTo(x, y - r);
    context.lineTo(x + r, y);
    context.lineTo(x, y + r);
    context.lineTo(x - r, y);
    context.closePath();
  }
  context.fillStyle = colours.frontier;
  context.fill();
  context.lineWidth = 1.5;
  context.strokeStyle = colours.halo;
  context.stroke();
}

function edgePaths(graph) {
  const { a, b, driven } = graph.edges;
  const paths = { seen: new Path2D(), driven: new Path2D() };
  for (let i = 0; i < a.length; i++) {
    const path = driven[i] ? paths.driven : paths.seen;
    path.moveTo(graph.x[a[i]], graph.y[a[i]]);
    path.lineTo(graph.x[b[i]], graph.y[b[i]]);
  }
  return paths;
}

export function drawPolicy(at) {
  const { context, store, colours } = at;
  const policy = store.get("policy");
  if (!policy) return;
  const arrows = store.memo("arrows", ["policy"], () => numbers(policy.arrows, "f4"));
  at.inScreen();
  context.beginPath();
  for (let i = 0; i < arrows.length; i += 4) {
    const [x0, y0] = at.screen(arrows[i], arrows[i + 1]);
    if (x0 < -50 || y0 < -50 || x0 > at.width + 50 || y0 > at.height + 50) continue;
    const [x1, y1] = at.screen(arrows[i + 2], arrows[i + 3]);
    const length = Math.hypot(x1 - x0, y1 - y0);
    if (length < 3) continue;
    const reach = Math.min(0.7 * length, 22), dx = (x1 - x0) / length, dy = (y1 - y0) / length;
    const tx = x0 + dx * reach, ty = y0 + dy * reach, head = Math.min(5, reach * 0.5);
    context.moveTo(x0, y0);
    context.lineTo(tx, ty);
    context.moveTo(tx - head * (dx - 0.6 * dy), ty - head * (dy + 0.6 * dx));
    context.lineTo(tx, ty);
    context.lineTo(tx - head * (dx + 0.6 * dy), ty - head * (dy - 0.6 * dx));
  }
  context.lineWidth = 1.6;
  context.strokeStyle = colours.policy;
  context.stroke();
}

function polyline(context, xy, first = 0, last = xy.length / 2) {
  context.beginPath();
  for (let i = first; i < last; i++) {
    if (i === first) context.moveTo(xy[2 * i], xy[2 * i + 1]);
    else context.lineTo(xy[2 * i], xy[2 * i + 1]);
  }
}

function stroke(at, colour, width, dash = []) {
  at.context.lineJoin = "round";
  at.context.lineWidth = width / at.scale;
  at.context.strokeStyle = colour;
  at.context.setLineDash(dash.map((part) => part / at.scale));
  at.context.stroke();
  at.context.setLineDash([]);
}

export function drawTarget(at) {
  const { context, store, colours } = at;
  const policy = store.get("policy");
  if (!policy || policy.target < 0) return;
  const route = store.memo("route", ["policy"], () => numbers(policy.route, "f4"));
  at.inMap();
  polyline(context, route);
  stroke(at, colours.policy, 2, [2, 5]);
  at.inScreen();
  const [x, y] = at.screen(policy.x, policy.y);
  context.beginPath();
  context.arc(x, y, 13, 0, 7);
  for (const [dx, dy] of [[1, 0], [0, 1], [-1, 0], [0, -1]]) {
    context.moveTo(x + 9 * dx, y + 9 * dy);
    context.lineTo(x + 18 * dx, y + 18 * dy);
  }
  context.lineWidth = 5;
  context.strokeStyle = colours.halo;
  context.stroke();
  context.lineWidth = 2.5;
  context.strokeStyle = colours.target;
  context.stroke();
}

export function drawTrail(at) {
  at.inMap();
  for (const xy of at.store.trail()) {
    polyline(at.context, xy);
    stroke(at, at.colours.trail, 2);
  }
}

export function drawOld(at) {
  const part = at.store.get("plan");
  if (!part) return;
  const old = at.store.memo("oldPath", ["plan"], () => numbers(part.old, "f4"));
  at.inOdom();
  polyline(at.context, old);
  stroke(at, at.colours.oldPath, 2.5, [6, 5]);
}

// The kept part of the old policy is thick and ends at a bar: there the new policy begins.
export function drawPlan(at) {
  const { context, store, colours } = at;
  const part = store.get("plan");
  if (!part || !part.valid) return;
  const xy = store.memo("newPath", ["plan"], () => numbers(part.xy, "f4"));
  at.inOdom();
  polyline(context, xy);
  stroke(at, colours.halo, 6);
  polyline(context, xy);
  stroke(at, colours.newPath, 3);
  const kept = Math.min(part.kept, xy.length / 2);
  if (kept < 2) return;
  polyline(context, xy, 0, kept);
  stroke(at, colours.keptPath, 6);
  const i = 2 * (kept - 1), dx = xy[i] - xy[i - 2], dy = xy[i + 1] - xy[i - 1];
  const length = Math.hypot(dx, dy) || 1, bar = 8 / at.scale;
  context.beginPath();
  context.moveTo(xy[i] - (dy / length) * bar, xy[i + 1] + (dx / length) * bar);
  context.lineTo(xy[i] + (dy / length) * bar, xy[i + 1] - (dx / length) * bar);
  stroke(at, colours.keptPath, 3);
}

export const FENCE_KINDS = {
  geofence: { name: "Geofence", says: "stay inside", colour: "geofence", dash: [] },
  no_go: { name: "No-go", says: "keep out", colour: "noGo", dash: [3, 4] },
  priority: { name: "Priority", says: "cover first", colour: "priority", dash: [10, 5] },
};

function ring(context, points) {
  context.beginPath();
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.closePath();
}

export function drawFences(at) {
  const { context, colours } = at;
  for (const fence of at.fences) {
    const kind = FENCE_KINDS[fence.kind] ?? FENCE_KINDS.no_go;
    for (const points of fence.rings) {
      at.inFrame(fence.frame);
      ring(context, points);
      if (fence.kind !== "geofence") {
        context.fillStyle = at.hatch(fence.kind);
        context.fill();
      }
      stroke(at, colours.halo, 5);
      ring(context, points);
      stroke(at, colours[kind.colour], 2.5, kind.dash);
    }
  }
}

export function drawPose(at) {
  const { context, store, colours } = at;
  const pose = store.get("pose");
  if (!pose) return;
  const stale = at.topicStale("sim/odometry");
  const [xx, xy, yy] = pose.cov;
  const mean = (xx + yy) / 2, gap = Math.sqrt(Math.max(0, ((xx - yy) / 2) ** 2 + xy * xy));
  at.inMap();
  context.beginPath();
  context.ellipse(pose.x, pose.y, CONFIDENCE_95 * Math.sqrt(mean + gap),
    CONFIDENCE_95 * Math.sqrt(Math.max(0, mean - gap)), 0.5 * Math.atan2(2 * xy, xx - yy), 0, 2 * Math.PI);
  context.fillStyle = colours.doubt;
  context.globalAlpha = 0.25;
  context.fill();
  context.globalAlpha = 1;
  stroke(at, colours.doubt, 1.5);
  at.inScreen();
  const [x, y] = at.screen(pose.x, pose.y);
  context.beginPath();
  [[0, 14], [2.5, 10], [Math.PI, 4], [-2.5, 10]].forEach(([turn, length], i) => {
    const angle = pose.yaw + turn;
    context[i ? "lineTo" : "moveTo"](x + length * Math.cos(angle), y - length * Math.sin(angle));
  });
  context.closePath();
  context.fillStyle = stale ? colours.stale : colours.robot;
  context.fill();
  context.lineWidth = 2;
  context.strokeStyle = colours.halo;
  context.stroke();
}

// A polygon that is being drawn: its points, and the line to the cursor.
export function drawDraft(at, draft) {
  const { context, colours } = at;
  const kind = FENCE_KINDS[draft.kind];
  const points = draft.cursor ? [...draft.points, draft.cursor] : draft.points;
  at.inMap();
  if (points.length > 1) {
    ring(context, points);
    stroke(at, colours.halo, 5);
    ring(context, points);
    stroke(at, colours[kind.colour], 2.5, [6, 4]);
  }
  at.inScreen();
  context.fillStyle = colours[kind.colour];
  context.strokeStyle = colours.halo;
  context.lineWidth = 2;
  for (const [px, py] of draft.points) {
    const [x, y] = at.screen(px, py);
    context.beginPath();
    context.arc(x, y, 5, 0, 7);
    context.fill();
    context.stroke();
  }
}

const DRAW = { coverage: drawCoverage, risk: drawRisk, local: drawLocal, graph: drawGraph, policy: drawPolicy,
  target: drawTarget, trail: drawTrail, old: drawOld, plan: drawPlan, fences: drawFences, pose: drawPose };

export function drawLayers(at, shown) {
  for (const [key] of LAYERS) if (shown[key]) DRAW[key](at);
}
