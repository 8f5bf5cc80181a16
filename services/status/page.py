"""The page at `/`: plain HTML, nothing loaded from elsewhere."""

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>PLGRIM</title>
<style>
  body { font: 15px/1.4 system-ui, sans-serif; margin: 1rem; color: #222; background: #fafafa; }
  main { display: flex; flex-wrap: wrap; gap: 1rem; }
  img { max-width: min(100%, 1000px); border: 1px solid #ccc; image-rendering: pixelated; }
  pre { font-size: 12px; margin: 0; white-space: pre-wrap; }
  section { flex: 1 1 22rem; }
  #late { color: #b2182b; }
</style>
<h1>PLGRIM</h1>
<p id="says">waiting for the status</p>
<p id="late"></p>
<main>
  <img id="map" alt="map of the mission" src="map.png">
  <section><pre id="status"></pre></section>
</main>
<script>
  const put = (id, text) => { document.getElementById(id).textContent = text; };
  async function renew() {
    try {
      const s = await (await fetch("api/v1/status", { cache: "no-store" })).json();
      const parts = [];
      if (s.mission) parts.push(s.mission.phase + " " + s.mission.finish + " (" + s.mission.reason + ")");
      if (s.coverage) parts.push((100 * s.coverage.belief).toFixed(1) + " % covered");
      if (s.mission) parts.push(s.mission.distance_m.toFixed(0) + " m");
      if (s.target) parts.push("target: " + s.target.reason);
      put("says", parts.join(" \u00b7 ") || "no mission yet");
      put("late", s.not_ready_because.join("; "));
      put("status", JSON.stringify(s, null, 1));
      document.getElementById("map").src = "map.png?" + Date.now();
    } catch (error) {
      put("late", "the status service does not answer");
    }
    setTimeout(renew, 1000);
  }
  renew();
</script>
</html>
"""
