// Quantities over time, one panel below the other, each with its values now and a cursor to drag.

const MARGIN = { l: 62, r: 10, t: 6, b: 8 }, LOWEST = 40; // [px]

function element(tag, parent, className = "", text = "") {
  const made = document.createElement(tag);
  made.className = className;
  made.textContent = text;
  parent.append(made);
  return made;
}

function panelLayout(panel, page, lowest) {
  const shape = (y0, y1, fillcolor) => ({ type: "rect", xref: "paper", x0: 0, x1: 1, y0, y1, fillcolor, line: { width: 0 }, layer: "below" });
  const level = y => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: y, y1: y, line: { color: "#333", width: 1.2, dash: "dash" }, layer: "above" });
  const shapes = [{ ...shape(0, 1, "#eceef1"), xref: "x", yref: "paper", x0: page.end_s - page.tail_s, x1: page.end_s }];
  if (panel.band) shapes.push(shape(panel.band[0], panel.band[1], "#009E732b"), ...panel.band.filter(y => y > panel.limits[0]).map(level));
  const log = panel.scale === "log";
  return {
    margin: { ...MARGIN, b: lowest ? LOWEST : MARGIN.b }, showlegend: false, hovermode: false, dragmode: false, shapes,
    annotations: [{ // an axis' own title would stand elsewhere in each panel, as far out as its numbers are wide
      text: `${panel.axis} [${panel.unit}]`, textangle: -90, showarrow: false, font: { size: 13 },
      xref: "paper", x: 0, xanchor: "center", xshift: 10 - MARGIN.l, yref: "paper", y: 0.5, yanchor: "middle",
    }],
    font: { family: "system-ui, 'DejaVu Sans', sans-serif", size: 12, color: "#333" },
    xaxis: {
      range: [0, page.end_s], fixedrange: true, showgrid: true, gridcolor: "#dfe3e7", zeroline: false, showticklabels: lowest,
      title: lowest ? { text: "time [s]", standoff: 4 } : undefined, linecolor: "#999", showline: true,
    },
    yaxis: {
      range: log ? panel.limits.map(Math.log10) : panel.limits, type: log ? "log" : "linear", fixedrange: true, zeroline: false,
      gridcolor: "#dfe3e7", linecolor: "#999", showline: true, nticks: 5, automargin: false,
      ...(log ? { dtick: 1, exponentformat: "none" } : {}),
      ...(panel.ticks.length ? { tickvals: panel.ticks.map(t => t[0]), ticktext: panel.ticks.map(t => t[1]) } : {}),
    },
  };
}

// `jump` is called with the time [s] that was clicked on or dragged to.
function makeCharts(parent, page, jump) {
  const panels = page.panels.map((panel, p) => {
    const lowest = p === page.panels.length - 1;
    const section = element("section", parent, lowest ? "panel lowest" : "panel");
    const head = element("h2", section, "", panel.label);
    const values = panel.lines.map(line => {
      const item = element("span", head);
      element("i", item).style.background = line.color;
      item.title = line.description;
      return { name: line.name, text: item.appendChild(new Text()) };
    });
    const plot = element("div", section, "plot"), drawing = element("div", plot, "drawing"), cursor = element("div", plot, "cursor");
    cursor.style.top = `${MARGIN.t}px`;
    cursor.style.bottom = `${lowest ? LOWEST : MARGIN.b}px`;
    const seek = event => {
      const { left, width } = plot.getBoundingClientRect();
      jump((event.clientX - left - MARGIN.l) / (width - MARGIN.l - MARGIN.r) * page.end_s);
    };
    plot.addEventListener("pointerdown", event => { plot.setPointerCapture(event.pointerId); seek(event); });
    plot.addEventListener("pointermove", event => { if (plot.hasPointerCapture(event.pointerId)) seek(event); });
    return { panel, values, drawing, cursor, layout: panelLayout(panel, page, lowest) };
  });
  parent.append(document.getElementById("legend")); // below them

  return {
    show: flight => Promise.all(panels.map(({ panel, drawing, layout }, p) => {
      const held = panel.held ? { shape: "hv" } : {};
      const traces = panel.lines.map((line, l) => ({
        type: "scatter", mode: "lines", x: flight.panels[p][l].map((_, k) => k * page.period_s), y: flight.panels[p][l],
        line: { color: line.color, width: panel.lines.length > 1 ? 1.2 : 1.7, ...held }, hoverinfo: "skip",
      }));
      return Plotly.react(drawing, traces, layout, { displayModeBar: false, responsive: true });
    })),
    move(flight, time, index) {
      const share = time / page.end_s;
      panels.forEach(({ panel, values, cursor }, p) => {
        cursor.style.left = `calc(${MARGIN.l}px + ${share} * (100% - ${MARGIN.l + MARGIN.r}px) - 1px)`;
        values.forEach(({ name, text }, l) => {
          const column = flight.panels[p][l], value = column[Math.min(index, column.length - 1)];
          text.data = `${name}${name ? " " : ""}${value === null ? "–" : value.toFixed(panel.decimals).replace("-", "−")} ${panel.unit}`;
        });
      });
    },
  };
}
