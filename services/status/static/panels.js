// The panels beside the map.

import { html, useEffect, useRef, useState } from "./vendor/htm-preact.module.js";
import { FENCE_KINDS } from "./layers.js";
import { MOTION, PHASES, STATES, age, clock, duration, metres, percent, targetWords } from "./words.js";

export function Mission({ status, policy, plan }) {
  const mission = status?.mission, coverage = status?.coverage;
  if (!mission) return html`<p class="soft">No mission state has come yet.</p>`;
  const budget = mission.time_budget_s > 0 ? ` of ${duration(mission.time_budget_s)}` : "";
  const facts = [
    ["Covered", coverage ? percent(coverage.belief) + (coverage.judge === null ? "" : ` (true: ${percent(coverage.judge)})`) : "–"],
    ["Time", duration(mission.elapsed_s) + budget],
    ["Driven", `${metres(mission.distance_m)}, home in ${metres(mission.return_distance_m)}`],
    ["Frontiers", coverage ? `${coverage.frontiers}${mission.left ? `; ${mission.left} places not covered yet` : ""}` : "–"],
    ["Target", targetWords(policy)],
    ["Motion", plan ? `${MOTION[plan.safety] ?? plan.safety}${plan.valid || plan.safety === "hold" || plan.safety === "done" ? "" : ", no path"}${
      plan.reason ? `: ${plan.reason}` : ""}` : "–"],
  ];
  return html`
    <p class="phase" data-phase=${mission.phase}><strong>${PHASES[mission.phase] ?? mission.phase}</strong>
      ${mission.reason ? html` <span class="soft">${mission.reason}</span>` : null}</p>
    <dl class="facts">${facts.map(([name, value]) => html`<div key=${name}><dt>${name}</dt><dd>${value}</dd></div>`)}</dl>`;
}

const COMMANDS = [
  ["start", "Start", ["idle"]],
  ["pause", "Pause", ["explore", "return"]],
  ["resume", "Resume", ["paused"]],
  ["home", "Return home", ["explore", "paused"]],
];
const STOPPABLE = ["idle", "explore", "paused", "return"];

export function Controls({ phase, lost, command, setBudget, answer }) {
  const [sure, setSure] = useState(false), [minutes, setMinutes] = useState("");
  const confirm = useRef(null);
  useEffect(() => sure && confirm.current?.focus(), [sure]);
  const budget = (event) => {
    event.preventDefault();
    if (minutes !== "") setBudget(60 * Number(minutes));
  };
  return html`
    <div class="buttons" role="group" aria-label="Mission">
      ${COMMANDS.map(([kind, name, phases]) => html`<button key=${kind} type="button" id=${`command-${kind}`}
        disabled=${lost || !phases.includes(phase)} onClick=${() => command(kind)}>${name}</button>`)}
      ${sure
        ? html`<button type="button" id="command-stop-sure" class="danger" ref=${confirm} disabled=${lost}
            onClick=${() => (setSure(false), command("stop"))}>Yes, end the mission</button>
            <button type="button" onClick=${() => setSure(false)}>No</button>`
        : html`<button type="button" id="command-stop" class="danger" disabled=${lost || !STOPPABLE.includes(phase)}
            onClick=${() => setSure(true)}>Stop…</button>`}
    </div>
    <form class="budget" onSubmit=${budget}>
      <label for="budget-minutes">Time budget, minutes (0: none)</label>
      <input id="budget-minutes" type="number" min="0" max="10000" step="any" inputmode="decimal" required
        value=${minutes} onInput=${(event) => setMinutes(event.target.value)} />
      <button id="set-budget" disabled=${lost}>Set</button>
    </form>
    <p class=${answer.ok === false ? "answer bad" : "answer"} role="status" id="answer">${answer.says}</p>`;
}

export function Fences({ fences, draft, lost, begin, finish, cancel, remove }) {
  return html`
    <div class="buttons" role="group" aria-label="Draw a polygon">
      ${draft
        ? html`<button type="button" id="draw-finish" class="primary" disabled=${draft.points.length < 3}
            onClick=${finish}>Finish (${draft.points.length})</button>
            <button type="button" id="draw-cancel" onClick=${cancel}>Cancel</button>`
        : Object.entries(FENCE_KINDS).map(([kind, { name, says }]) => html`<button key=${kind} type="button"
            id=${`draw-${kind}`} disabled=${lost} onClick=${() => begin(kind)}>
            <span class="swatch" data-fence=${kind}></span>${name}<span class="soft"> ${says}</span></button>`)}
    </div>
    ${draft ? html`<p class="soft">Click the corners of the ${FENCE_KINDS[draft.kind].name.toLowerCase()} polygon on the map; a
      double click or Enter closes it. With keys: move the map with the arrows, Space sets a corner in the middle,
      Backspace takes one back, Escape cancels.</p>` : null}
    <ul class="fences">
      ${fences.map((fence) => html`<li key=${fence.id}><span class="swatch" data-fence=${fence.kind}></span>
        <span>${FENCE_KINDS[fence.kind]?.name ?? fence.kind} ${fence.name || fence.id} <span class="soft">in ${fence.frame}</span></span>
        <button type="button" disabled=${lost} aria-label=${`Remove ${FENCE_KINDS[fence.kind]?.name} ${fence.name || fence.id}`}
          onClick=${() => remove(fence)}>Remove</button></li>`)}
    </ul>
    ${!fences.length && !draft ? html`<p class="soft">No polygons are set.</p>` : null}`;
}

export function Services({ status, sinceS }) {
  const stages = status?.stages ?? [];
  return html`<div class="scroll" tabindex="0" role="region" aria-label="Services, table"><table class="services">
    <thead><tr><th scope="col">Service</th><th scope="col">State</th><th scope="col" class="number">Rate</th>
      <th scope="col" class="number wide">Step</th><th scope="col" class="number">Age</th><th scope="col" class="number">Restarts</th></tr></thead>
    <tbody>${stages.map((stage) => {
      const [sign, words] = STATES[stage.state] ?? ["?", stage.state];
      const late = stage.age_s === null ? null : stage.age_s + sinceS;
      const heard = stage.state === "ok" || stage.state === "not_ready"; // else its last figures are those of then
      const waiting = stage.waiting_for.length ? `waits for ${stage.waiting_for.join(", ")}` : "";
      const wrong = [stage.last_error && `last error: ${stage.last_error}`, stage.degraded && `degraded: ${stage.degraded}`]
        .filter(Boolean).join("; ");
      return html`<tr key=${stage.service} data-state=${stage.state}>
        <th scope="row">${stage.service}</th><td><span class="sign" aria-hidden="true">${sign}</span> ${words}</td>
        <td class="number">${heard ? `${stage.rate_hz.toFixed(1)} Hz` : "–"}</td>
        <td class="number wide">${heard ? `${stage.step_p50_ms.toFixed(1)} ms` : "–"}</td>
        <td class="number">${age(late)}</td>
        <td class="number">${status.restarts?.[stage.service] ?? 0}</td></tr>
        ${wrong || waiting ? html`<tr class="more" key=${`${stage.service}-more`}><td colspan="6">
          ${wrong ? html`<strong>${wrong}</strong> ` : null}${waiting}</td></tr>` : null}`;
    })}</tbody></table></div>`;
}

const SHOWN = 200;

export function Events({ events, beganS }) {
  const [all, setAll] = useState(true);
  const shown = events.filter((event) => all || event.severity !== "info").slice(-SHOWN).reverse();
  return html`
    <label class="check"><input type="checkbox" checked=${!all} onChange=${() => setAll(!all)} /> only warnings and errors</label>
    <ol class="events" tabindex="0" role="log" aria-label="Events, newest first">
      ${shown.map((event) => html`<li key=${event.id} data-severity=${event.severity}>
        <time>${clock(event.mission_time_s - beganS)}</time>
        <span>${event.severity === "info" ? "" : html`<strong>${event.severity}: </strong>`}${event.text}</span></li>`)}
    </ol>
    ${shown.length ? null : html`<p class="soft">Nothing has happened yet.</p>`}`;
}

// Asks for a token once; the answer is what was typed, or null.
export function TokenDialog({ ask, answer }) {
  const dialog = useRef(null), [text, setText] = useState("");
  useEffect(() => {
    if (ask && !dialog.current.open) dialog.current.showModal();
    if (!ask && dialog.current.open) dialog.current.close();
  }, [ask]);
  const done = (value) => {
    setText("");
    answer(value);
  };
  return html`<dialog ref=${dialog} aria-labelledby="token-title" onCancel=${() => done(null)}>
    <form method="dialog" onSubmit=${(event) => (event.preventDefault(), done(text.trim() || null))}>
      <h2 id="token-title">Token needed</h2>
      <p>${ask}</p>
      <label for="token">Token</label>
      <input id="token" type="password" autocomplete="off" value=${text} onInput=${(event) => setText(event.target.value)} />
      <div class="buttons"><button class="primary" id="token-give">Go on</button>
        <button type="button" onClick=${() => done(null)}>Cancel</button></div>
    </form></dialog>`;
}
