// The page: puts the link, the map and the panels together.

import { html, render, useEffect, useReducer, useRef, useState } from "./vendor/htm-preact.module.js";
import { Api } from "./api.js";
import { LAYERS } from "./layers.js";
import { Link } from "./link.js";
import { MapView } from "./map.js";
import { Controls, Events, Fences, Mission, Services, TokenDialog } from "./panels.js";
import { Plots } from "./plots.js";
import { Store } from "./store.js";
import { age } from "./words.js";

const PANELS_MS = 250; // the panels are renewed at most so often; the map with every frame

const store = new Store();
const app = { store, link: null, map: null, wake: () => {}, askToken: () => {} };
window.plgrim = app;

const api = new Api((why) => new Promise((resolve) => app.askToken(why, resolve)));
const address = new URL("api/v1/live", location.href);
address.protocol = address.protocol.replace("http", "ws");

let woken = 0;
function wakePanels() {
  woken ||= setTimeout(() => {
    woken = 0;
    app.wake();
  }, PANELS_MS);
}

// Fences as the map and the list want them: rings of points in their frame.
function fences() {
  return store.memo("fences", ["fences"], () => store.get("fences")?.fences ?? []);
}

app.link = new Link(address.href, (parts, full) => {
  store.take(parts, full);
  if (app.map) app.map.fences = fences();
  app.map?.redraw();
  wakePanels();
}, wakePanels);

function startLayers() {
  let held = {};
  try {
    held = JSON.parse(localStorage.getItem("plgrim.layers") ?? "{}") ?? {};
  } catch {
    // kept by another version, or no storage in this browser
  }
  return Object.fromEntries(LAYERS.map(([key, , shown]) => [key, held[key] ?? shown]));
}

function useMap(canvas, shown) {
  const [, renew] = useReducer((n) => n + 1, 0);
  useEffect(() => {
    app.map = new MapView(canvas.current, store, () => renew());
    app.map.fences = fences();
    renew();
  }, []);
  useEffect(() => {
    try {
      localStorage.setItem("plgrim.layers", JSON.stringify(shown));
    } catch {
      // no storage in this browser: the choice is not kept
    }
    if (!app.map) return;
    app.map.shown = shown;
    app.map.redraw();
  }, [shown]);
  return app.map;
}

function LayerBox({ shown, setShown }) {
  const narrow = matchMedia("(max-width: 700px)").matches;
  return html`<details class="layers" open=${!narrow}>
    <summary>Layers</summary>
    <div>${LAYERS.map(([key, name, , topic]) => {
      const state = topic && store.topic(topic);
      const late = state?.stale ? html` <span class="late">${age(state.age_s)} old</span>` : null;
      return html`<label key=${key} class="check"><input type="checkbox" id=${`layer-${key}`} checked=${shown[key]}
        onChange=${() => setShown({ ...shown, [key]: !shown[key] })} /><span class="swatch" data-layer=${key}></span>
        ${name}${late}</label>`;
    })}</div></details>`;
}

function ReadOut({ map }) {
  const at = map?.readOut();
  return html`<output class="readout" id="readout">${at
    ? html`<span>${at.frame}</span> <span>x ${at.x.toFixed(2)}</span> <span>y ${at.y.toFixed(2)} m</span>
        <span>risk ${at.risk}</span> <span>${at.coverage}</span>`
    : html`<span class="soft">point at the map to read it out</span>`}</output>`;
}

function MapBox({ shown, setShown, tools }) {
  const canvas = useRef(null);
  const map = useMap(canvas, shown);
  const mark = lostMark(), lost = mark !== "";
  return html`<section class=${lost ? "mapbox lost" : "mapbox"} aria-label="Map">
    <canvas ref=${canvas} tabindex="0" role="application" id="map" aria-describedby="map-keys"
      aria-label="Map of the mission" data-drawing=${tools.draft ? "yes" : null}></canvas>
    <p id="map-keys" class="hidden">Arrows move, plus and minus zoom, F follows the robot, 0 shows everything.</p>
    <div class="maptools" role="group" aria-label="View">
      <button type="button" id="zoom-in" aria-label="Zoom in" title="Zoom in (+)" onClick=${() => map.zoom(1.4)}>+</button>
      <button type="button" id="zoom-out" aria-label="Zoom out" title="Zoom out (−)" onClick=${() => map.zoom(1 / 1.4)}>−</button>
      <button type="button" id="follow" aria-pressed=${String(map?.follow ?? true)} title="Follow the robot (F)"
        onClick=${() => map.setFollow(!map.follow)}>Follow</button>
      <button type="button" id="fit" title="Show everything (0)" onClick=${() => map.fit()}>All</button>
    </div>
    <${LayerBox} shown=${shown} setShown=${setShown} />
    <${ReadOut} map=${map} />
    ${lost ? html`<div class="lostmark" aria-hidden="true">${mark}</div>` : null}
  </section>`;
}

// Written across a map that is no longer that of now; empty while it is.
function lostMark() {
  const { link } = app, status = store.get("status");
  if (link.lost && link.everHeard) return hasEnded(status) ? "MISSION OVER" : "LINK LOST";
  return status && status.silent_s !== null ? "ROBOT SILENT" : "";
}

function hasEnded(status) {
  return ["done", "stopped"].includes(status?.mission?.phase);
}

// What is wrong, in one bar: the link above all else.
function Bar({ status }) {
  const { link } = app;
  if (!link.everHeard && link.refused)
    return html`<div class="bar bad" role="alert" id="bar"><strong>No live data.</strong> This page needs a token to read.
      <button type="button" id="read-token" onClick=${readToken}>Give a token</button></div>`;
  if (!link.everHeard) return html`<div class="bar" role="status" id="bar">Connecting to the robot…</div>`;
  if (link.lost && hasEnded(status))
    return html`<div class="bar bad" role="alert" id="bar"><strong>Mission over</strong> (${status.mission.finish}), and the
      service of this page has ended or is out of reach: what you see is ${age(link.silentMs() / 1000)} old.</div>`;
  if (link.lost)
    return html`<div class="bar bad" role="alert" id="bar"><strong>LINK LOST</strong> What you see is
      ${" "}${age(link.silentMs() / 1000)} old. The robot goes on by itself; commands do not reach it. Reconnecting…</div>`;
  const silent_s = status?.silent_s ?? null;
  if (silent_s !== null)
    return html`<div class="bar bad" role="alert" id="bar"><strong>ROBOT SILENT</strong> Nothing has come from it for
      ${" "}<span aria-live="off">${age(silent_s)}</span>; what you see is that old. Its link or its services are down; a robot
      that is well goes on by itself. Commands may not reach it: their answer says so.</div>`;
  const reasons = status?.not_ready_because ?? [];
  if (reasons.length)
    return html`<div class="bar warn" role="status" id="bar"><strong>Not ready:</strong> ${reasons.join("; ")}</div>`;
  return html`<div class="bar good" role="status" id="bar">Linked and ready</div>`;
}

async function readToken() {
  const token = await new Promise((resolve) => app.askToken("Reading needs a token here.", resolve));
  if (token && (await api.openSession(token)).ok) app.link.retry();
}

function useTools(setAnswer) {
  const [draft, setDraft] = useState(null);
  const set = (value) => {
    setDraft(value);
    if (!app.map) return;
    app.map.draft = value;
    app.map.redraw();
  };
  const begin = (kind) => {
    set({ kind, points: [], cursor: null });
    app.map.follow = false;
    app.map.canvas.focus();
  };
  const finish = async () => {
    const { kind, points } = app.map.draft;
    if (points.length < 3) return;
    set(null);
    setAnswer({ says: "sending the polygon…" });
    setAnswer(await api.change("POST", ...fenceRequest(kind, points)));
  };
  const cancel = () => set(null);
  const remove = async (fence) => setAnswer(await api.change("DELETE", `api/v1/mission/fences/${encodeURIComponent(fence.id)}`));
  useEffect(() => {
    if (app.map) Object.assign(app.map, { onFinish: finish, onCancel: cancel });
  });
  return { draft, begin, finish, cancel, remove };
}

// A polygon in `map` as GeoJSON, its ring closed.
function fenceRequest(kind, points) {
  const ring = [...points, points[0]].map(([x, y]) => [Number(x.toFixed(3)), Number(y.toFixed(3))]);
  const geojson = { type: "Polygon", coordinates: [ring] };
  return ["api/v1/mission/fences", { kind, frame: "map", geojson }];
}

function Page() {
  const [, renew] = useReducer((n) => n + 1, 0);
  const [shown, setShown] = useState(startLayers);
  const [answer, setAnswer] = useState({ says: "" });
  const [ask, setAsk] = useState(null);
  const tools = useTools(setAnswer);
  app.wake = renew;
  app.askToken = (why, resolve) => setAsk({ why, resolve });
  const status = store.get("status"), policy = store.get("policy"), plan = store.get("plan");
  const { link } = app, sinceS = status ? (performance.now() - store.receivedAt.get("status")) / 1000 : 0;
  const command = async (kind) => {
    setAnswer({ says: `${kind}: sent…` });
    setAnswer(await api.change("POST", `api/v1/mission/${kind}`));
  };
  const setBudget = async (seconds) => setAnswer(await api.change("PUT", "api/v1/mission/time-budget", { time_budget_s: seconds }));
  const title = lostMark() ? `✕ ${lostMark().toLowerCase()}` : status?.mission?.phase ?? "…";
  useEffect(() => void (document.title = `${title} · PLGRIM ${status?.robot ?? ""}`));
  return html`
    <header><h1>PLGRIM <span class="soft">${status?.robot ?? ""}</span></h1><${Bar} status=${status} /></header>
    <main class=${lostMark() ? "old" : ""}>
      <${MapBox} shown=${shown} setShown=${setShown} tools=${tools} />
      <div class="panels">
        <section aria-labelledby="h-mission"><h2 id="h-mission">Mission</h2>
          <${Mission} status=${status} policy=${policy} plan=${plan} />
          <${Controls} phase=${status?.mission?.phase} lost=${link.lost} command=${command} setBudget=${setBudget}
            answer=${answer} /></section>
        <section aria-labelledby="h-fences"><h2 id="h-fences">Polygons</h2>
          <${Fences} fences=${fences()} lost=${link.lost} ...${tools} /></section>
        <section aria-labelledby="h-events"><h2 id="h-events">Events</h2>
          <${Events} events=${store.events()} beganS=${status?.began_s ?? 0} /></section>
        <section aria-labelledby="h-services"><h2 id="h-services">Services</h2>
          <${Services} status=${status} sinceS=${sinceS} /></section>
        <section aria-labelledby="h-curves"><h2 id="h-curves">Curves</h2><${Plots} curve=${store.rows("curve")} steps=${store.rows("steps")} /></section>
      </div>
    </main>
    <${TokenDialog} ask=${ask?.why} answer=${(token) => (ask?.resolve(token), setAsk(null))} />`;
}

render(html`<${Page} />`, Object.assign(document.getElementById("app"), { textContent: "" }));

// The address that `plgrim demo` prints ends in #token=...: it becomes a session, and is gone from the address bar.
const given = /^#token=(.+)$/.exec(location.hash)?.[1];
if (given) {
  history.replaceState(null, "", location.pathname + location.search);
  if ((await api.openSession(decodeURIComponent(given))).ok) app.link.retry();
}
