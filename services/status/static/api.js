// What changes something: requests with an idempotency key, and the token that they need.

export class Api {
  // askToken(why): promise of a token, or of null when the operator does not give one.
  constructor(askToken) {
    this.askToken = askToken;
  }

  // The answer of a request that changes something: {ok, says}. The same key on every try: carried out once.
  async change(method, path, body) {
    const key = crypto.randomUUID?.() ?? `${Date.now()}-${Math.random().toString(16).slice(2)}`;
    let why = "Commands need the token of an operator.";
    for (;;) {
      const answer = await this.send(method, path, body, key);
      if (answer.status !== 401 && answer.status !== 403) return answer;
      if (answer.status === 403) why = `${answer.says}. Give the token of an operator.`;
      const token = await this.askToken(why);
      if (!token) return { ...answer, ok: false, says: "not done: no token was given" };
      const session = await this.openSession(token);
      why = session.ok ? why : "That token is not known here. Try again.";
    }
  }

  async send(method, path, body, key) {
    const headers = { "Idempotency-Key": key };
    if (body !== undefined) headers["Content-Type"] = "application/json";
    try {
      const options = { method, headers, signal: AbortSignal.timeout(10_000) };
      const response = await fetch(path, { ...options, body: body === undefined ? undefined : JSON.stringify(body) });
      const text = await response.text();
      return { ok: response.ok, status: response.status, says: says(response, text), json: parsed(text) };
    } catch (error) {
      return { ok: false, status: 0, says: `the robot's page does not answer (${error.message})` };
    }
  }

  // The browser keeps the token in a cookie that no script can read.
  async openSession(token) {
    const headers = { Authorization: `Bearer ${token}` };
    try {
      const response = await fetch("api/v1/session", { method: "POST", headers });
      return { ok: response.ok };
    } catch {
      return { ok: false };
    }
  }
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

// What happened, in words: of the answer's own, as far as it has some.
function says(response, text) {
  const json = parsed(text);
  const detail = json?.detail ?? json?.says ?? json?.reason ?? json?.message;
  if (typeof detail === "string") return detail;
  if (Array.isArray(detail) && detail[0]?.msg)
    return detail.map((one) => `${one.loc?.slice(1).join(".")}: ${one.msg}`).join("; ");
  return response.ok ? "done" : `refused (${response.status})`;
}
