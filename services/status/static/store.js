// The parts of the live state, decoded once into what the map and the panels need.

const KINDS = { f4: Float32Array, u4: Uint32Array, u2: Uint16Array, u1: Uint8Array };

// Bytes of a part as numbers: copied, since a typed array wants its offset aligned.
export function numbers(bytes, kind) {
  return new KINDS[kind](bytes.slice().buffer);
}

export class Store {
  constructor() {
    this.parts = new Map();
    this.receivedAt = new Map(); // performance.now() by key
    this.stamp = 0; // grows with every change
    this.changed = {}; // stamp of the newest change by the first word of the key
    this.tiles = new Map();
    this.tilesChanged = new Set();
  }

  take(parts, full) {
    const now = performance.now();
    if (full) for (const key of this.parts.keys()) if (!(key in parts)) this.set(key, null, now);
    for (const [key, part] of Object.entries(parts)) this.set(key, part, now);
  }

  set(key, part, now) {
    const word = key.split(":")[0];
    this.changed[word] = ++this.stamp;
    this.receivedAt.set(key, now);
    if (part === null) this.parts.delete(key);
    else this.parts.set(key, part);
    if (word === "cov") this.tilesChanged.add(key);
  }

  get(key) {
    return this.parts.get(key);
  }

  // Parts whose key begins with this word, in the order of their numbers.
  all(word) {
    const found = [...this.parts.keys()].filter((key) => key.startsWith(word + ":"));
    found.sort((a, b) => Number(a.split(":")[1]) - Number(b.split(":")[1]));
    return found.map((key) => this.parts.get(key));
  }

  // Computed from the parts of some words, and again only when one of them has changed.
  memo(name, words, compute) {
    this.memos ??= new Map();
    const stamp = Math.max(0, ...words.map((word) => this.changed[word] ?? 0));
    const held = this.memos.get(name);
    if (held && held.stamp === stamp) return held.value;
    const value = compute();
    this.memos.set(name, { stamp, value });
    return value;
  }

  // Age of a topic in seconds, growing while nothing comes; null: never received. stale: by the table of topics.
  topic(name) {
    const status = this.get("status");
    const found = status?.topics.find((topic) => topic.name === name);
    if (!found) return null;
    const since = (performance.now() - this.receivedAt.get("status")) / 1000;
    return { age_s: found.age_s + since, stale: found.stale, rate_hz: found.rate_hz };
  }

  graph() {
    return this.memo("graph", ["graph"], () => joinGraph(this.all("graph")));
  }

  // Columns of numbers by name, or null while there are none.
  rows(word) {
    return this.memo(word, [word], () => joinRows(this.all(word)));
  }

  events() {
    return this.memo("events", ["events"], () => this.all("events").flatMap((part) => part.events));
  }

  trail() {
    return this.memo("trail", ["trail"], () => this.all("trail").map((part) => numbers(part.xy, "f4")));
  }
}

function joinGraph(chunks) {
  const nodes = chunks.map((chunk) => numbers(chunk.id, "u4"));
  const count = nodes.reduce((sum, ids) => sum + ids.length, 0);
  const graph = { id: new Uint32Array(count), kind: new Uint8Array(count), x: new Float32Array(count),
    y: new Float32Array(count), gain: new Float32Array(count) };
  let last = 0;
  for (const ids of nodes) if (ids.length) last = Math.max(last, ids[ids.length - 1]);
  const place = new Int32Array(last + 1).fill(-1);
  let at = 0;
  chunks.forEach((chunk, c) => {
    const xy = numbers(chunk.xy, "f4");
    graph.id.set(nodes[c], at);
    graph.kind.set(chunk.kind, at);
    graph.gain.set(numbers(chunk.gain, "f4"), at);
    for (let i = 0; i < nodes[c].length; i++, at++) {
      graph.x[at] = xy[2 * i];
      graph.y[at] = xy[2 * i + 1];
      place[nodes[c][i]] = at;
    }
  });
  graph.edges = joinEdges(chunks, place, last);
  graph.place = place;
  return graph;
}

function joinEdges(chunks, place, last) {
  const edges = { a: [], b: [], risk: [], driven: [] };
  for (const chunk of chunks) {
    const a = numbers(chunk.a, "u4"), b = numbers(chunk.b, "u4");
    for (let i = 0; i < a.length; i++) {
      if (b[i] > last || place[a[i]] < 0 || place[b[i]] < 0) continue;
      edges.a.push(place[a[i]]);
      edges.b.push(place[b[i]]);
      edges.risk.push(chunk.edge_risk[i] / 255);
      edges.driven.push(chunk.driven[i]);
    }
  }
  return edges;
}

function joinRows(chunks) {
  if (!chunks.length) return null;
  const names = chunks[0].columns;
  const columns = Object.fromEntries(names.map((name) => [name, []]));
  for (const chunk of chunks) {
    const rows = numbers(chunk.rows, "f4");
    for (let i = 0; i < rows.length; i += names.length)
      names.forEach((name, k) => columns[name].push(Number.isNaN(rows[i + k]) ? null : rows[i + k]));
  }
  return columns;
}
