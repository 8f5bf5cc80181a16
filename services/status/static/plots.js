// Curves over the mission, by uPlot.

import { html, useEffect, useMemo, useRef } from "./vendor/htm-preact.module.js";
import { clock } from "./words.js";

const SERIES_MAX = 1500; // points that are drawn of a long curve

function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function thin(columns) {
  const step = Math.ceil(columns[0].length / SERIES_MAX);
  return step <= 1 ? columns : columns.map((column) => column.filter((_, i) => i % step === 0));
}

export function Plot({ label, columns, series, unit, range }) {
  const place = useRef(null), plot = useRef(null);
  useEffect(() => {
    const axis = { stroke: css("--text-soft"), grid: { stroke: css("--line"), width: 1 }, ticks: { show: false },
      font: "12px system-ui, sans-serif" };
    const options = {
      width: place.current.clientWidth || 300,
      height: 150,
      cursor: { y: false, points: { size: 6 } },
      legend: { live: true },
      scales: { x: { time: false }, y: { range } },
      axes: [
        { ...axis, size: 28, space: 70, values: (_, marks) => marks.map(clock) },
        { ...axis, size: 54, values: (_, marks) => marks.map((mark) => `${+mark.toFixed(3)}${unit}`) },
      ],
      series: [{ label: "at", value: (_, v) => (v === null ? "–" : clock(v)) },
        ...series.map(({ name, colour, dash }) => ({ label: name, stroke: css(colour), width: 2, dash,
          points: { show: false }, spanGaps: true,
          value: (_, v) => (v === null || v === undefined ? "–" : `${v.toFixed(1)}${unit}`) }))],
    };
    plot.current = new uPlot(options, thin(columns), place.current);
    const observer = new ResizeObserver(() => {
      plot.current?.setSize({ width: place.current.clientWidth || 300, height: 150 });
    });
    observer.observe(place.current);
    return () => {
      observer.disconnect();
      plot.current.destroy();
      plot.current = null;
    };
  }, [matchMedia("(prefers-color-scheme: dark)").matches]);
  useEffect(() => plot.current?.setData(thin(columns)), [columns]);
  return html`<figure class="plot" aria-label=${label}><figcaption>${label}</figcaption><div ref=${place}></div></figure>`;
}

export const STEP_SERIES = [
  ["riskmap", "--plot-1", []], ["irm", "--plot-2", []], ["gcp", "--plot-3", []], ["lcp", "--plot-4", []],
  ["reconciler", "--plot-5", [8, 4]], ["mission", "--plot-6", [2, 3]],
].map(([name, colour, dash]) => ({ name, colour, dash }));

const SHARE = [0, 100];

function coverageColumns(curve, judged) {
  const share = (column) => column.map((value) => (value === null ? null : 100 * value));
  const columns = [curve.elapsed_s, share(curve.belief)];
  return judged ? [...columns, share(curve.judge)] : columns;
}

export function Plots({ curve, steps }) {
  const judged = curve?.judge.some((value) => value !== null) ?? false;
  const coverage = useMemo(() => curve && coverageColumns(curve, judged), [curve]);
  const times = useMemo(() => steps && [steps.elapsed_s, ...STEP_SERIES.map(({ name }) => steps[name])], [steps]);
  if (!curve || !steps || curve.elapsed_s.length < 2) return html`<p class="soft">The curves begin with the mission.</p>`;
  const series = [{ name: "belief", colour: "--plot-1" }];
  if (judged) series.push({ name: "true (simulator)", colour: "--plot-5", dash: [8, 4] });
  return html`
    <${Plot} label="Coverage over time" columns=${coverage} series=${series} unit=" %" range=${SHARE} key=${judged} />
    <${Plot} label="Median step time" columns=${times} series=${STEP_SERIES} unit=" ms"
      range=${(_, low, high) => [0, 1.1 * Math.max(high ?? 1, 1)]} />`;
}
