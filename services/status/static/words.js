// Numbers as people say them.

export function duration(seconds) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return "–";
  const s = Math.max(0, Math.round(seconds));
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${String(s % 60).padStart(2, "0")} s`;
  return `${Math.floor(s / 3600)} h ${String(Math.floor((s % 3600) / 60)).padStart(2, "0")} min`;
}

export function age(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  return seconds < 10 ? `${seconds.toFixed(1)} s` : duration(seconds);
}

export function metres(value) {
  return value < 10 ? `${value.toFixed(1)} m` : `${Math.round(value)} m`;
}

export function percent(share) {
  return `${(100 * share).toFixed(1)} %`;
}

export const PHASES = { idle: "Waiting for the start", explore: "Exploring", paused: "Paused",
  return: "Returning home", stopped: "Stopped", done: "Finished" };

// What the robot does in each safety state of the plan.
export const MOTION = { run: "drives", degraded: "drives slowly", hold: "stands still", return: "drives home",
  done: "stands for good" };

export const STATES = { ok: ["●", "working"], not_ready: ["◐", "not ready"], silent: ["▲", "silent"],
  missing: ["✕", "not heard of"] };

// As on a clock, short: 1:05, 1:02:05.
export function clock(seconds) {
  const s = Math.max(0, Math.round(seconds)), two = (n) => String(n).padStart(2, "0");
  const minutes = `${s < 3600 ? Math.floor(s / 60) : two(Math.floor((s % 3600) / 60))}:${two(s % 60)}`;
  return s < 3600 ? minutes : `${Math.floor(s / 3600)}:${minutes}`;
}

// Why this target: "frontier 41: 38 cells expected, 12 m, low risk".
export function targetWords(policy) {
  if (!policy || policy.target < 0) return "no target";
  const risk = policy.risk < 0.1 ? "low risk" : policy.risk < 0.3 ? "medium risk" : "high risk";
  return `frontier ${policy.target}: ${(policy.gain / Math.LN2).toFixed(0)} cells expected, ${metres(policy.distance_m)}, ${risk}`;
}
