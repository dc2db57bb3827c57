// The pendulum, seen along its axis: a rod from the pivot, upright at angle zero, counter-clockwise positive.

function rodScene(div, page) {
  const { length_m: length, max_torque_N_m: most } = page.rod, { wanted } = page;
  const tip = (angle, radius = length) => [-radius * Math.sin(angle), radius * Math.cos(angle)];
  const turn = (from, to, radius, n = 40) => Array.from({ length: n + 1 }, (_, i) => tip(from + (to - from) * i / n, radius));
  const line = (points, style, more = {}) =>
    ({ type: "scatter", mode: "lines", x: points.map(p => p[0]), y: points.map(p => p[1]), line: style, hoverinfo: "skip", ...more });
  const MOVING = [0, 1, 2, 3];
  let flight;

  function moving(now) {
    const swept = 0.5 * Math.PI * now.actions[0] / most, radius = 0.32 * length;
    const head = tip(swept, radius), side = Math.sign(swept) || 1, size = Math.min(0.09 * length, Math.abs(swept) * radius);
    const behind = swept - side * size / radius;
    const arrow = [...turn(0, swept, radius), tip(behind, radius + 0.5 * size), head, tip(behind, radius - 0.5 * size)];
    const path = flight.angle_rad.slice(0, now.index + 1).map(a => tip(a));
    const parts = [[[0, 0], tip(now.angle)], arrow, [tip(now.angle)], [...path, tip(now.angle)]];
    return { x: parts.map(part => part.map(p => p[0])), y: parts.map(part => part.map(p => p[1])) };
  }

  return {
    choose(chosen) { flight = chosen; },
    async show(now) {
      const m = moving(now), part = i => m.x[i].map((x, n) => [x, m.y[i][n]]);
      const wedge = [[0, 0], ...turn(-wanted.angle_rad, wanted.angle_rad, 1.12 * length), [0, 0]];
      const axis = (title, anchor) => ({
        title: { text: title, font: { size: 13 } }, range: [-1.25 * length, 1.25 * length], fixedrange: true, zeroline: false,
        gridcolor: "#e3e6ea", tickfont: { size: 11, color: "#555" }, ...anchor,
      });
      await Plotly.react(div, [
        line(part(0), { color: "#3a3f45", width: 12 }),
        line(part(1), { color: "#D55E00", width: 4 }),
        line(part(2), {}, { mode: "markers", marker: { color: "#0072B2", size: 16 } }),
        line(part(3), { color: "#56B4E9", width: 2 }),
        line(wedge, { width: 0 }, { fill: "toself", fillcolor: "#009E7340" }),
        line([[0, 0]], {}, { mode: "markers", marker: { color: "#fff", size: 9, line: { color: "#222", width: 3 } } }),
      ], {
        margin: { l: 56, r: 16, t: 40, b: 48 }, showlegend: false, hovermode: false, dragmode: false,
        font: { family: "system-ui, 'DejaVu Sans', sans-serif" },
        xaxis: axis("horizontal [m]", { constrain: "domain" }), yaxis: axis("height [m]", { scaleanchor: "x", constrain: "domain" }),
      }, { displayModeBar: false, responsive: true });
    },
    move: now => Plotly.restyle(div, moving(now), MOVING),
    follow: null,
    scale: () => `rod to scale; arc: the torque, a quarter turn is ${most} N m; green: within ${wanted.angle_rad} rad of upright`,
    probe: now => tip(now.angle),
  };
}
