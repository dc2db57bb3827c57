// The page: which start and what time is shown, and the controls. `#start=12&t=1.5` in the address says both.

const page = JSON.parse(document.getElementById("data").textContent);
const RATES = [0.25, 0.5, 1, 2, 4];
const $ = id => document.getElementById(id);
const state = { flight: page.flights[0], time: 0, playing: false, rate: 1, frames: 0 };

// The flight's motion at a time: samples, and what lies between two of them. Actions are held over a period.
function at(flight, time) {
  const index = Math.min(Math.floor(time / page.period_s + 1e-6), flight.samples - 1);
  const next = Math.min(index + 1, flight.samples - 1), part = Math.min(time / page.period_s - index, 1);
  const between = rows => rows.map(row => row[index] + part * (row[next] - row[index]));
  const actions = flight.panels.at(-1).map(row => row[Math.min(index, row.length - 1)]); // the last panel's
  if (page.rod) {
    let step = flight.angle_rad[next] - flight.angle_rad[index];
    step -= 2 * Math.PI * Math.round(step / (2 * Math.PI));
    return { index, actions, angle: flight.angle_rad[index] + part * step };
  }
  const unit = v => v.map(x => x / Math.hypot(...v));
  const up = unit(between(flight.up)), towards = between(flight.forward);
  const along = towards.reduce((sum, x, c) => sum + x * up[c], 0);
  const forward = unit(towards.map((x, c) => x - along * up[c]));
  const left = [0, 1, 2].map(c => up[(c + 1) % 3] * forward[(c + 2) % 3] - up[(c + 2) % 3] * forward[(c + 1) % 3]);
  return { index, actions, position: between(flight.position_m), forward, left, up };
}

const lastTime = () => (state.flight.samples - 1) * page.period_s;
const now = () => at(state.flight, state.time);

// The scene draws one state at a time, and the latest asked for next: a slow machine skips frames.
let drawing = false, stale = false;
async function draw() {
  const { flight, time } = state;
  charts.move(flight, time, Math.floor(time / page.period_s + 1e-6));
  $("scrub").value = time;
  $("clock").textContent = `${time.toFixed(2)} / ${page.end_s.toFixed(2)} s`;
  if (drawing) { stale = true; return; }
  drawing = true;
  do {
    stale = false;
    await scene.move(now());
    state.frames += 1;
  } while (stale);
  drawing = false;
}

function seek(time) {
  state.time = Math.max(0, Math.min(time, lastTime()));
  return draw();
}

let lastTick = 0;
function tick(clock) {
  if (!state.playing) return;
  const elapsed_s = Math.min((clock - lastTick) / 1000, 0.25);
  lastTick = clock;
  seek(state.time + elapsed_s * state.rate);
  if (state.time >= lastTime()) play(false);
  else requestAnimationFrame(tick);
}

function play(on) {
  if (on === state.playing) return;
  if (on && state.time >= lastTime()) seek(0);
  state.playing = on;
  $("play").textContent = on ? "❚❚" : "►";
  if (on) requestAnimationFrame(clock => { lastTick = clock; tick(clock); });
  else remember();
}

let whenIdle;
function remember() {
  clearTimeout(whenIdle);
  whenIdle = setTimeout(() => history.replaceState(null, "", `#start=${state.flight.start}&t=${+state.time.toFixed(3)}`), 150);
}

async function choose(start, time) {
  play(false);
  state.flight = page.flights.find(flight => flight.start === start) ?? page.flights[0];
  state.time = Math.max(0, Math.min(time, lastTime()));
  $("start").value = state.flight.start;
  $("outcome").textContent = state.flight.outcome;
  $("outcome").style.color = state.flight.success ? "#00684c" : "#a84300";
  scene.choose(state.flight);
  $("scale").textContent = scene.scale(); // before anything is drawn: its height is taken from the scene's
  await Promise.all([scene.show(now()), charts.show(state.flight)]);
  await draw();
}

function fromAddress() {
  const asked = new URLSearchParams(location.hash.slice(1));
  return choose(asked.has("start") ? Number(asked.get("start")) : page.flights[0].start, Number(asked.get("t")) || 0);
}

$("title").textContent = page.title;
$("description").textContent = page.description;
for (const flight of page.flights) $("start").add(new Option(flight.label, flight.start));
for (const rate of RATES) $("rate").add(new Option(`×${rate}`, rate, rate === 1, rate === 1));
$("scrub").max = page.end_s;
$("play").textContent = "►";
$("legend").innerHTML = `<i style="background:#eceef1"></i>evaluated: the last ${page.tail_s} s<i style="background:#009E732b"></i>`
  + `within tolerance${page.vehicle ? "<span>f1 ↖: front left, from above</span>" : ""}`;

const scene = page.rod ? rodScene($("scene"), page) : vehicleScene($("scene"), page, remember);
const charts = makeCharts($("charts"), page, time => { play(false); seek(time); remember(); });
$("follow-label").hidden = !scene.follow;

$("play").addEventListener("click", () => play(!state.playing));
$("start").addEventListener("change", event => { choose(Number(event.target.value), state.playing ? 0 : state.time).then(remember); });
$("rate").addEventListener("change", event => { state.rate = Number(event.target.value); });
$("scrub").addEventListener("input", event => { play(false); seek(Number(event.target.value)); remember(); });
$("follow").addEventListener("change", event => { scene.follow(event.target.checked, now()); });
window.addEventListener("hashchange", fromAddress);
window.addEventListener("keydown", event => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const typed = event.target.tagName;
  const ownSpace = typed === "SELECT" || typed === "BUTTON" || event.target.type === "checkbox";
  if (event.key === " " && !ownSpace) { event.preventDefault(); play(!state.playing); }
  const step = { ArrowLeft: -0.1, ArrowRight: 0.1 }[event.key];
  if (step && typed !== "SELECT") { event.preventDefault(); play(false); seek(state.time + step); remember(); }
});

// What tests look at; `ready` resolves once the first start is drawn.
window.qrlView = { state, page, choose, place: () => scene.probe(now()), ready: fromAddress() };
