// The quadrotor in 3D: drawn from its task's motors, to scale or magnified by a factor that the page names.
// World and body: x forward, y left, z up [m].

const MAGNIFICATIONS = [1, 2, 3, 5, 10, 20, 30, 50, 100, 200, 300, 500, 1000];
const VISIBLE = 0.28; // of the scene: what the vehicle spans at least
const BAR = 1.7; // length of a thrust bar at full thrust, in arm lengths

// Triangles of one color each. A vertex with a motor in `lifted` moves up by that motor's thrust.
function mesh() {
  const shape = { vertices: [], lifted: [], faces: [], colors: [] };
  shape.prism = (corners, low, high, color, motor = -1) => {
    const first = shape.vertices.length, n = corners.length;
    for (const [z, lifts] of [[low, -1], [high, motor]])
      for (const [x, y] of corners) { shape.vertices.push([x, y, z]); shape.lifted.push(lifts); }
    for (let i = 0; i < n; i++) {
      const a = first + i, b = first + (i + 1) % n;
      shape.faces.push([a, b, b + n], [a, b + n, a + n]);
      if (i > 1) shape.faces.push([first, a - 1, a], [first + n, a - 1 + n, a + n]);
    }
    while (shape.colors.length < shape.faces.length) shape.colors.push(color);
  };
  return shape;
}

const polygon = (x, y, radius, n) =>
  Array.from({ length: n }, (_, i) => {
    const angle = 2 * Math.PI * (i + 0.5) / n;
    return [x + radius * Math.cos(angle), y + radius * Math.sin(angle)];
  });

function strip(x, y, halfWidth) { // from the body's center to x, y
  const length = Math.hypot(x, y) || 1, u = -y / length * halfWidth, v = x / length * halfWidth;
  return [[u, v], [-u, -v], [x - u, y - v], [x + u, y + v]];
}

function vehicleShape(motors) {
  const shape = mesh(), arm = Math.max(...motors.map(m => Math.hypot(...m.position_m)));
  const apart = motors.flatMap((a, i) => motors.slice(0, i).map(b => Math.hypot(a.position_m[0] - b.position_m[0], a.position_m[1] - b.position_m[1])));
  const rotor = Math.min(0.5 * arm, 0.47 * Math.min(...apart));
  shape.prism([[0.34, 0.2], [-0.34, 0.2], [-0.34, -0.2], [0.34, -0.2]].map(c => c.map(x => x * arm)), 0, 0.2 * arm, "#3a3f45");
  shape.prism([[0.34, 0.2], [-0.34, 0.2], [-0.34, -0.2], [0.34, -0.2]].map(c => c.map(x => x * arm)), -0.1 * arm, 0, "#c9ced4");
  shape.prism([[0.34, 0.2], [0.34, -0.2], [1.0, 0]].map(c => c.map(x => x * arm)), 0, 0.14 * arm, "#000000"); // the nose
  for (const [i, motor] of motors.entries()) {
    const [x, y] = motor.position_m;
    shape.prism(strip(x, y, 0.06 * arm), 0, 0.08 * arm, "#6b7278");
    shape.prism(polygon(x, y, rotor, 20), 0.12 * arm, 0.16 * arm, motor.color);
    shape.prism(polygon(x, y, 0.012 * arm, 4), 0.16 * arm, (0.16 + BAR) * arm, "#9aa1a8"); // where full thrust is
    shape.prism(polygon(x, y, 0.1 * arm, 6), 0.16 * arm, 0.16 * arm, motor.color, i);
  }
  return { ...shape, arm, span: 2 * (arm + rotor) };
}

// A tube of `tolerance` about the circle, or a ball about the point: where a flight has to be.
function toleranceShape(radius, tolerance) {
  const around = radius ? 72 : 24, across = 14, vertices = [], faces = [];
  for (let i = 0; i < around; i++)
    for (let j = 0; j < across; j++) {
      const u = 2 * Math.PI * i / around, v = radius ? 2 * Math.PI * j / across : Math.PI * (j / (across - 1) - 0.5);
      const r = radius + tolerance * Math.cos(v);
      vertices.push([r * Math.cos(u), r * Math.sin(u), tolerance * Math.sin(v)]);
      const next = (i + 1) % around, up = (j + 1) % across;
      if (radius || up) faces.push([i * across + j, next * across + j, next * across + up], [i * across + j, next * across + up, i * across + up]);
    }
  return { vertices, faces };
}

const columns = vertices => [0, 1, 2].map(c => vertices.map(v => v[c]));

function meshTrace(shape, more) {
  const [x, y, z] = columns(shape.vertices), [i, j, k] = columns(shape.faces);
  return { type: "mesh3d", x, y, z, i, j, k, hoverinfo: "skip", flatshading: true, ...more };
}

const line3d = (x, y, z, line) => ({ type: "scatter3d", mode: "lines", x, y, z, line, hoverinfo: "skip" });

function arrowheads(radius, size, count, color) { // on the circle; counter-clockwise for a size above 0
  const shape = mesh();
  for (let n = 0; n < count; n++) {
    const angle = 2 * Math.PI * n / count + 0.4, c = Math.cos(angle), s = Math.sin(angle);
    const place = (along, out) => [radius * c - along * s + out * c, radius * s + along * c + out * s];
    shape.prism([place(size, 0), place(-size, 0.6 * size), place(-size, -0.6 * size)], -0.08 * Math.abs(size), 0.08 * Math.abs(size), color);
  }
  return shape;
}

function vehicleScene(div, page, onCamera) {
  const { motors } = page.vehicle, shape = vehicleShape(motors), { wanted } = page;
  const light = { ambient: 0.88, diffuse: 0.35, specular: 0.05, roughness: 0.9, fresnel: 0 };
  let flight, magnified, box, following = false, offset = null, overview = null, held = false;

  function extent() {
    const reach = wanted.radius_m + wanted.tolerance_m;
    const spans = flight.position_m.map((values, axis) => {
      const seen = values.filter(v => v !== null);
      if (wanted.path_m) return [Math.min(...seen, ...wanted.path_m[axis]), Math.max(...seen, ...wanted.path_m[axis])];
      const target = axis < 2 ? reach : wanted.tolerance_m;
      return [Math.min(-target, ...seen), Math.max(target, ...seen)];
    });
    const longest = Math.max(...spans.map(([a, b]) => b - a));
    magnified = MAGNIFICATIONS.find(m => m * shape.span >= VISIBLE * longest) ?? MAGNIFICATIONS.at(-1);
    const margin = 0.5 * magnified * shape.span, least = 0.5 * longest;
    return spans.map(([a, b]) => {
      const more = margin + Math.max(0, least - (b - a)) / 2;
      return [a - more, b + more];
    });
  }

  // Vertices of the vehicle in the world at what `at` says.
  function placed({ position, forward, left, up, actions }) {
    return columns(shape.vertices.map(([x, y, z], i) => {
      const motor = shape.lifted[i];
      if (motor >= 0) z += BAR * shape.arm * Math.max(0.004, actions[motor] / motors[motor].most);
      return [0, 1, 2].map(c => position[c] + magnified * (x * forward[c] + y * left[c] + z * up[c]));
    }));
  }

  function moving(now) {
    const [x, y, z] = placed(now), [px, py, pz] = now.position, floor = box[2][0];
    const path = flight.position_m.map((values, c) => [...values.slice(0, now.index + 1), now.position[c]]);
    const ahead = flight.position_m.map((values, c) => [now.position[c], ...values.slice(now.index + 1, flight.samples)]);
    const of = [
      [x, path[0], ahead[0], [px, px], [px]], [y, path[1], ahead[1], [py, py], [py]],
      [z, path[2], ahead[2], [pz, floor], [floor]],
    ];
    if (wanted.path_m) of.forEach((values, c) => values.push([wanted.path_m[c][Math.min(now.index, wanted.path_m[c].length - 1)]]));
    return { x: of[0], y: of[1], z: of[2] };
  }

  const MOVING = wanted.path_m ? [0, 1, 2, 3, 4, 5] : [0, 1, 2, 3, 4];
  const LOG_LEAST = -3, LOG_MOST = Math.log10(wanted.tolerance_m); // colors of the trail: from 1 mm to the tolerance

  function traces(now) {
    const m = moving(now), [X, Y, Z] = flight.position_m, floor = Z.map(z => z === null ? null : box[2][0]);
    const all = [
      meshTrace({ ...shape, vertices: m.x[0].map((_, i) => [m.x[0][i], m.y[0][i], m.z[0][i]]) }, { facecolor: shape.colors, lighting: light }),
      line3d(m.x[1], m.y[1], m.z[1], { color: "#0072B2", width: 5 }),
      line3d(m.x[2], m.y[2], m.z[2], { color: "#a3aab2", width: 3 }),
      line3d(m.x[3], m.y[3], m.z[3], { color: "#8a9199", width: 2, dash: "dot" }),
      { type: "scatter3d", mode: "markers", x: m.x[4], y: m.y[4], z: m.z[4], hoverinfo: "skip", marker: { color: "#6b7278", size: 4 } },
      ...(wanted.path_m ? [{ type: "scatter3d", mode: "markers", x: m.x[5], y: m.y[5], z: m.z[5], hoverinfo: "skip", marker: { color: "#007a59", size: 6, symbol: "diamond" } }] : []),
      line3d(X, Y, floor, { color: "#dcdfe3", width: 3 }),
    ];
    if (flight.beside_m) all.push(line3d(...flight.beside_m, { color: "#D55E00", width: 3 }));
    if (wanted.path_m) {
      const [x, y, z] = wanted.path_m, off = flight.panels[1][0];
      const color = off.map(e => Math.min(LOG_MOST, Math.max(LOG_LEAST, Math.log10(e || 1e-9))));
      all.push(line3d(x, y, z, { color: "#007a59", width: 3, dash: "dash" }));
      all.push(line3d(X, Y, Z, { color, colorscale: "Portland", cmin: LOG_LEAST, cmax: LOG_MOST, width: 6 }));
      return all;
    }
    all.push(
      meshTrace(toleranceShape(wanted.radius_m, wanted.tolerance_m), { color: "#009E73", opacity: wanted.radius_m ? 0.16 : 0.28, flatshading: false, lighting: light }),
    );
    if (wanted.radius_m) {
      const turn = Array.from({ length: 145 }, (_, i) => 2 * Math.PI * i / 144);
      all.push(line3d(turn.map(a => wanted.radius_m * Math.cos(a)), turn.map(a => wanted.radius_m * Math.sin(a)), turn.map(() => 0), { color: "#007a59", width: 4, dash: "dash" }));
      const arrows = arrowheads(wanted.radius_m, 0.1 * wanted.radius_m * (wanted.clockwise ? -1 : 1), 4, "#007a59");
      all.push(meshTrace(arrows, { facecolor: arrows.colors, lighting: light }));
    } else {
      all.push({ type: "scatter3d", mode: "markers", x: [0], y: [0], z: [0], hoverinfo: "skip", marker: { color: "#007a59", size: 5, symbol: "diamond" } });
    }
    return all;
  }

  function layout() {
    const spans = box.map(([a, b]) => b - a), longest = Math.max(...spans);
    const step = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20].find(d => longest / d <= 7) ?? 50;
    const axis = (name, c) => ({
      title: { text: `${name} [m]`, font: { size: 13 } }, range: box[c], dtick: step, tick0: 0, autorange: false,
      gridcolor: "#d9dde2", zeroline: false, showbackground: c === 2, backgroundcolor: "#f4f6f8", showspikes: false,
      tickfont: { size: 11, color: "#555" }, color: "#333",
    });
    const [x, y, z] = spans.map(s => s / longest);
    return {
      margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: false, uirevision: "kept", paper_bgcolor: "#fff", hovermode: false,
      font: { family: "system-ui, 'DejaVu Sans', sans-serif" },
      scene: {
        xaxis: axis("x", 0), yaxis: axis("y", 1), zaxis: axis("z", 2), aspectmode: "manual", aspectratio: { x, y, z },
        camera: overview ?? { eye: { x: 1.05, y: -1.53, z: 0.85 }, center: { x: -0.05, y: -0.04, z: -0.13 }, up: { x: 0, y: 0, z: 1 } },
        dragmode: "turntable",
      },
    };
  }

  const inScene = position => {
    const { aspectratio } = div.layout.scene;
    const [x, y, z] = box.map(([a, b], c) => (position[c] - (a + b) / 2) / (b - a) * Object.values(aspectratio)[c]);
    return { x, y, z };
  };

  const plus = (a, b) => ({ x: a.x + b.x, y: a.y + b.y, z: a.z + b.z });

  function follow(now) {
    if (held) return undefined;
    const center = inScene(now.position);
    return { "scene.camera": { center, eye: plus(center, offset), up: { x: 0, y: 0, z: 1 } } };
  }

  return {
    choose(chosen) {
      flight = chosen;
      if (div.layout && !following) overview = div.layout.scene.camera;
      box = extent();
    },
    async show(now) {
      await Plotly.react(div, traces(now), layout(), { displayModeBar: false, responsive: true, scrollZoom: true });
      if (!div.dataset.ready) {
        div.dataset.ready = "yes";
        div.addEventListener("pointerdown", () => { held = true; }, true);
        window.addEventListener("pointerup", () => { held = false; });
        div.on("plotly_relayout", change => {
          const camera = change["scene.camera"];
          if (camera && following) offset = plus(camera.eye, { x: -camera.center.x, y: -camera.center.y, z: -camera.center.z });
          if (camera) onCamera();
        });
      }
      if (following) await Plotly.relayout(div, follow(now));
    },
    async move(now) {
      const camera = following && follow(now);
      if (camera) await Plotly.update(div, moving(now), camera, MOVING);
      else await Plotly.restyle(div, moving(now), MOVING);
    },
    async follow(on, now) {
      if (on === following) return;
      if (on) {
        overview = div.layout.scene.camera;
        const near = 0.7, { eye } = overview, far = Math.hypot(eye.x, eye.y, eye.z) || 1;
        offset = { x: near * eye.x / far, y: near * eye.y / far, z: near * eye.z / far };
      }
      following = on;
      await Plotly.relayout(div, on ? follow(now) : { "scene.camera": overview });
    },
    scale() {
      const metres = BAR * shape.arm * magnified, most = Math.max(...motors.map(m => m.most));
      const size = magnified === 1 ? "vehicle to scale" : `vehicle drawn ×${magnified}`;
      const target = wanted.radius_m ? "circle" : "target", { name, unit } = page.acted;
      const shown = wanted.path_m ? ` green: the reference, dashed; trail: blue 1 mm off it, red ${wanted.tolerance_m} m`
        : ` green: within ${wanted.tolerance_m} m of the ${target}`;
      const beside = flight.beside_m ? " orange: the int8 kernel;" : "";
      return `${size}, black nose forward; ${name} bars: ${metres.toPrecision(2)} m is ${most.toPrecision(3)} ${unit};${beside}${shown}`;
    },
    probe: now => placed(now).map(values => values[0]),
  };
}
