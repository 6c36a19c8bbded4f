// Figures: uPlot draws, this says what. Pointer, keyboard and screen reader reach the same values; a drag, + and − zoom.
"use strict";

(() => {
  const { el } = fieldcal;
  const COLOURS = ["c1", "c2", "c3", "c4", "fg"];
  const QUIET = { before: "muted", refused: "muted", trend: "c2" };
  const MOST_ROWS = 400;
  const STEP = 0.25; // of what is shown, a press of a key
  const alive = new Set();
  let printing = false;

  const colour = (name) => {
    const style = getComputedStyle(document.documentElement);
    return ((printing && style.getPropertyValue(`--paper-${name}`)) || style.getPropertyValue(`--${name}`)).trim();
  };
  const faint = (name) => `color-mix(in srgb, ${colour(name)} 18%, transparent)`;

  const utc = (s) => new Date(s * 1e3).toISOString().slice(0, 16).replace("T", " ");
  const digits = (v, n = 6) => {
    if (v === null || v === undefined) return "–";
    const rounded = Number(v.toPrecision(n));
    return rounded !== 0 && Math.abs(rounded) < 1e-3 ? rounded.toExponential() : String(rounded);
  };
  const withSd = (v, sd, unit) => `${digits(v)}${sd ? ` ± ${digits(sd, 2)}` : ""}${unit ? ` ${unit}` : ""}`;

  const ticks = (u, values) => {
    const known = values.filter((v) => v !== null);
    if (known.length < 2) return values.map((v) => digits(v));
    const step = Math.abs(known[1] - known[0]);
    const most = Math.max(...known.map(Math.abs));
    let places = -Math.floor(Math.log10(step) + 1e-9);
    const whole = step * 10 ** places;
    if (Math.abs(whole - Math.round(whole)) > 1e-6) places += 1; // steps of 2.5
    if (most < 1e5 && places <= 4) return values.map((v) => (v === null ? "" : v.toFixed(Math.max(0, places))));
    return values.map((v) => {
      if (v === null) return "";
      return Math.abs(v) < step / 2 ? "0" : v.toExponential(Math.max(0, Math.floor(Math.log10(Math.abs(v)) + 1e-9) + places));
    });
  };

  // Dates as the tables write them, UTC; the time of day where a step is less than a day.
  const dates = (u, values) => {
    const step = values.length > 1 ? values[1] - values[0] : 0;
    return values.map((v, i) => {
      const [date, time] = utc(v).split(" ");
      if (step >= 86400) return date;
      return i === 0 || time === "00:00" ? `${time}\n${date}` : time;
    });
  };

  // Curves on one x: where a curve has no point of its own, undefined, over which lines go on.
  const aligned = (chart, panel) => {
    const groups = [...new Set(panel.curves.map((curve) => curve.x))];
    const points = groups.flatMap((group) => chart.xs[group].map((x, i) => [x, group, i])).sort((a, b) => a[0] - b[0]);
    const spread = (group, values) => points.map(([, own, i]) => (own === group ? values[i] : undefined));
    return { x: points.map(([x]) => x), spread };
  };

  const nearest = (xs, x) => {
    let low = 0, high = xs.length - 1;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (xs[middle] < x) low = middle + 1;
      else high = middle;
    }
    return low > 0 && x - xs[low - 1] <= xs[low] - x ? low - 1 : low;
  };

  const ink = (panel, i) => QUIET[panel.curves[i].kind] || COLOURS[(panel.curves[i].colour ?? i) % COLOURS.length];

  const yRange = (chart, panel, min, max) => {
    let low = Infinity, high = -Infinity;
    for (const every of [false, true]) {
      for (const curve of panel.curves) {
        if (curve.kind === "refused" && !every) continue;
        const sds = (curve.sd || []).filter((v) => v !== null).sort((a, b) => a - b);
        const bar = sds.length ? sds[sds.length >> 1] : 0;
        chart.xs[curve.x].forEach((x, i) => {
          if (x < min || x > max || curve.y[i] === null) return;
          low = Math.min(low, curve.low?.[i] ?? curve.y[i] - bar);
          high = Math.max(high, curve.high?.[i] ?? curve.y[i] + bar);
        });
      }
      if (low <= high) break;
    }
    if (!(low <= high)) return [0, 1];
    const pad = 0.08 * (high - low || Math.abs(high) || 1);
    return [low - pad, high + pad];
  };

  const drawn = (chart, panel) => (u) => {
    const { ctx } = u;
    ctx.save();
    ctx.beginPath();
    ctx.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
    ctx.clip();
    ctx.lineWidth = devicePixelRatio;
    panel.curves.forEach((curve, i) => {
      ctx.strokeStyle = colour(ink(panel, i));
      ctx.beginPath();
      chart.xs[curve.x].forEach((x, k) => {
        const y = curve.y[k];
        if (y === null || x < u.scales.x.min || x > u.scales.x.max) return;
        const at = u.valToPos(x, "x", true), to = u.valToPos(y, "y", true), d = 3 * devicePixelRatio;
        if (curve.kind === "refused") {
          ctx.moveTo(at - d, to - d), ctx.lineTo(at + d, to + d), ctx.moveTo(at - d, to + d), ctx.lineTo(at + d, to - d);
        } else if (curve.sd?.[k]) {
          ctx.moveTo(at, u.valToPos(y - curve.sd[k], "y", true)), ctx.lineTo(at, u.valToPos(y + curve.sd[k], "y", true));
        }
      });
      ctx.stroke();
    });
    if (panel.marked !== null && panel.marked !== undefined) {
      const at = u.valToPos(panel.marked, "x", true);
      ctx.strokeStyle = colour("warn");
      ctx.setLineDash([4 * devicePixelRatio, 3 * devicePixelRatio]);
      ctx.beginPath(), ctx.moveTo(at, u.bbox.top), ctx.lineTo(at, u.bbox.top + u.bbox.height), ctx.stroke();
    }
    ctx.restore();
  };

  const seriesOf = (panel, curve, i) => {
    const stroke = () => colour(ink(panel, i));
    const point = { show: true, size: 6, stroke, fill: curve.kind === "open" ? () => colour("bg") : stroke };
    if (curve.kind === "line") return { stroke, width: 1, pxAlign: 0, points: { show: false } };
    if (curve.kind === "trend") return { stroke, width: 1.5, pxAlign: 0, points: { show: false } };
    if (curve.kind === "joined") return { stroke, width: 1, points: point };
    return { stroke, paths: () => null, points: curve.kind === "refused" ? { show: false } : point };
  };

  class Figure {
    constructor(place, chart, download) {
      this.place = place;
      this.chart = chart;
      this.view = chart.views[0];
      this.plots = [];
      this.panels = el("div", { class: "panels", tabindex: "0", role: "group" });
      this.readout = el("p", { class: "readout", "aria-live": "polite" });
      this.table = el("details", { class: "values" }, el("summary", {}, "Values as a table"));
      this.table.addEventListener("toggle", () => this.table.open && this.tabulate());
      this.panels.addEventListener("keydown", (event) => this.key(event));
      place.replaceChildren(this.bar(download), this.panels, this.readout, this.table);
      this.draw();
      new ResizeObserver(() => this.resize()).observe(place);
      alive.add(this);
    }

    bar(download) {
      const button = (text, name, act) => {
        const made = el("button", { type: "button", "aria-label": `${text}, ${name}: ${this.chart.title}`, title: name }, text);
        made.addEventListener("click", act);
        return made;
      };
      const bar = el("div", { class: "bar" }, el("strong", {}, this.chart.title));
      if (this.chart.views.length > 1) {
        const select = el("select", { "aria-label": `What is shown: ${this.chart.title}` });
        this.chart.views.forEach((view, i) => select.append(el("option", { value: i }, view.name)));
        select.addEventListener("change", () => ((this.view = this.chart.views[select.value]), this.draw()));
        bar.append(select);
      }
      bar.append(
        button("+", "Zoom in", () => this.zoom(1 - 2 * STEP)),
        button("−", "Zoom out", () => this.zoom(1 / (1 - 2 * STEP))),
        button("Reset", "Show all", () => this.reset()),
        button("CSV", "Download what is shown as CSV", () => this.download()),
      );
      if (download) bar.append(el("a", { href: download, download: "" }, "Parquet"));
      return bar;
    }

    draw() {
      this.plots.forEach((u) => u.destroy());
      this.panels.replaceChildren();
      const xs = this.view.panels.flatMap((panel) => panel.curves.flatMap((curve) => this.chart.xs[curve.x]));
      const low = Math.min(...xs), high = Math.max(...xs);
      const pad = (high - low || Math.abs(high) || 1) * 0.02;
      this.whole = [low - pad, high + pad];
      this.shown = this.kept() || this.whole;
      this.at = null;
      this.legends = [];
      this.plots = xs.length ? this.view.panels.map((panel) => this.panel(panel)) : [];
      const names = this.view.panels.flatMap((panel) => panel.curves.map((curve) => curve.name));
      this.panels.setAttribute(
        "aria-label",
        `Figure ${this.chart.title}, ${this.view.name}: ${[...new Set(names)].join(", ")}.` +
          " Arrow keys read values, plus and minus zoom, shift with arrows moves, 0 shows all.",
      );
      if (this.table.open) this.tabulate();
    }

    panel(panel) {
      const { chart, view } = this;
      const { x, spread } = aligned(chart, panel);
      const data = [x], series = [{}], bands = [];
      panel.curves.forEach((curve, i) => {
        data.push(spread(curve.x, curve.y));
        series.push(seriesOf(panel, curve, i));
        if (curve.high) {
          for (const values of [curve.high, curve.low]) {
            data.push(spread(curve.x, values));
            series.push({ stroke: "transparent", width: 0, points: { show: false } });
          }
          bands.push({ series: [series.length - 2, series.length - 1], fill: () => faint(ink(panel, i)) });
        }
      });
      const box = el("div", { class: "panel" });
      const values = panel.curves.map(() => el("span", { class: "value" }));
      const head = [panel.title, panel.unit && `(${panel.unit})`].filter(Boolean).join(" ");
      const legend = el("p", { class: "legend" }, el("strong", {}, head));
      panel.curves.forEach((curve, i) =>
        legend.append(" ", el("span", { class: `swatch ${curve.kind} ${ink(panel, i)}` }), ` ${curve.name} `, values[i]),
      );
      this.legends.push(values);
      box.append(legend);
      this.panels.append(box);
      const last = panel === view.panels[view.panels.length - 1];
      const axis = { stroke: () => colour("fg"), ticks: { stroke: () => colour("line") }, grid: { stroke: () => colour("line"), width: 0.5 } };
      const u = new uPlot(
        {
          width: this.width(),
          height: view.panels.length > 1 ? (last ? 198 : 140) : 260,
          tzDate: (ts) => uPlot.tzDate(new Date(ts * 1e3), "Etc/UTC"),
          legend: { show: false },
          scales: { x: { time: view.time, range: () => this.shown }, y: { range: (own) => yRange(chart, panel, own.scales.x.min ?? -Infinity, own.scales.x.max ?? Infinity) } },
          axes: [
            { ...axis, size: last ? 50 : 10, label: last ? view.x : undefined, labelSize: 18, space: view.time ? 90 : 50, values: last ? (view.time ? dates : ticks) : () => [] },
            { ...axis, size: 86, values: ticks },
          ],
          cursor: { drag: { x: true, y: false, setScale: false }, points: { show: false }, y: false, bind: { dblclick: () => () => this.reset() } },
          series,
          bands,
          hooks: {
            draw: [drawn(chart, panel)],
            setCursor: [(own) => this.pointed(own)],
            setSelect: [(own) => this.selected(own)],
          },
        },
        data,
        box,
      );
      u.root.setAttribute("aria-hidden", "true");
      return u;
    }

    width() {
      return Math.max(240, this.panels.clientWidth || this.place.clientWidth);
    }

    resize() {
      for (const u of this.plots) if (Math.abs(u.width - this.width()) > 1) u.setSize({ width: this.width(), height: u.height });
    }

    refresh() {
      for (const u of this.plots) u.redraw(true, true);
    }

    // What is shown of x: in every panel, and in the address.
    range(low, high) {
      const most = this.whole[1] - this.whole[0];
      const wide = Math.min(Math.max(high - low, most * 1e-5), most);
      low = Math.min(Math.max(low, this.whole[0]), this.whole[1] - wide);
      this.shown = [low, low + wide];
      for (const u of this.plots) u.setScale("x", { min: this.shown[0], max: this.shown[1] });
      const all = wide >= most;
      fieldcal.setState(this.chart.id, all ? "" : `${this.view.name}~${digits(low, 12)}~${digits(low + wide, 12)}`);
      if (this.table.open) this.tabulate();
    }

    kept() {
      const [name, low, high] = (fieldcal.state().get(this.chart.id) || "").split("~");
      return name === this.view.name && Number(high) > Number(low) ? [Number(low), Number(high)] : null;
    }

    reset() {
      this.range(...this.whole);
    }

    zoom(factor) {
      const [low, high] = this.shown;
      const about = this.at !== null && this.at >= low && this.at <= high ? this.at : (low + high) / 2;
      this.range(about - (about - low) * factor, about + (high - about) * factor);
    }

    selected(u) {
      if (u.select.width > 4) this.range(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
      u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    }

    pointed(u) {
      if (this.quiet) return;
      if (u.cursor.left === null || u.cursor.left < 0) return;
      this.read(u.posToVal(u.cursor.left, "x"), u);
    }

    // Values at x in every panel: of each curve its nearest point.
    read(x, from) {
      this.at = x;
      this.quiet = true;
      for (const u of this.plots) if (u !== from) u.setCursor({ left: u.valToPos(x, "x"), top: -1 });
      this.quiet = false;
      let nearby = null;
      this.view.panels.forEach((panel, p) =>
        panel.curves.forEach((curve, c) => {
          const xs = this.chart.xs[curve.x];
          const i = nearest(xs, x);
          this.legends[p][c].textContent = withSd(curve.y[i], curve.sd?.[i] ?? (curve.high && (curve.high[i] - curve.y[i])), "");
          const off = Math.abs(xs[i] - x);
          if (curve.kind !== "trend" && (!nearby || off < nearby.off)) nearby = { off, x: xs[i], of: curve.of?.[i] };
        }),
      );
      if (!nearby) return;
      const at = this.view.time ? `${utc(nearby.x)} UTC` : `${this.view.x}: ${digits(nearby.x)}`;
      this.readout.replaceChildren(at);
      if (nearby.of) this.readout.append(", flight ", el("a", { href: fieldcal.page(`flight-${nearby.of}`) }, nearby.of));
    }

    // The next point to the right or left, for the keyboard; spoken with its values.
    step(way) {
      const [low, high] = this.shown;
      const curves = this.view.panels.flatMap((panel) => panel.curves.filter((curve) => curve.kind !== "trend"));
      const xs = [...new Set(curves.flatMap((curve) => this.chart.xs[curve.x]))].sort((a, b) => a - b).filter((x) => x >= low && x <= high);
      if (!xs.length) return;
      const now = this.at === null ? (way > 0 ? -1 : xs.length) : nearest(xs, this.at);
      const x = xs[Math.min(Math.max(now + way, 0), xs.length - 1)];
      this.read(x, null);
      const told = this.view.panels.flatMap((panel, p) =>
        panel.curves.map((curve, c) => `${panel.title} ${curve.name} ${this.legends[p][c].textContent} ${panel.unit}`.trim()),
      );
      this.readout.append(el("span", { class: "unseen" }, `: ${told.join("; ")}`));
    }

    key(event) {
      if (event.target !== this.panels || event.ctrlKey || event.metaKey || event.altKey) return;
      const wide = this.shown[1] - this.shown[0];
      const move = (share) => this.range(this.shown[0] + share * wide, this.shown[1] + share * wide);
      const keys = {
        ArrowRight: () => (event.shiftKey ? move(STEP) : this.step(1)),
        ArrowLeft: () => (event.shiftKey ? move(-STEP) : this.step(-1)),
        "+": () => this.zoom(1 - 2 * STEP),
        "=": () => this.zoom(1 - 2 * STEP),
        "-": () => this.zoom(1 / (1 - 2 * STEP)),
        0: () => this.reset(),
        Escape: () => this.reset(),
      };
      if (!keys[event.key]) return;
      event.preventDefault();
      keys[event.key]();
    }

    // Points of the view that is shown, within what is shown of x, a row a point.
    rows() {
      const [low, high] = this.shown;
      return this.view.panels.flatMap((panel) =>
        panel.curves.flatMap((curve) =>
          this.chart.xs[curve.x].flatMap((x, i) =>
            x < low || x > high || curve.y[i] === null ? [] : [{ panel, curve, i, x }],
          ),
        ),
      );
    }

    tabulate() {
      const rows = this.rows();
      const names = ["panel", "curve", this.view.x, "value", "± sd"];
      const body = el("tbody", {});
      for (const { panel, curve, i, x } of rows.slice(0, MOST_ROWS)) {
        const cells = [curve.name, this.view.time ? utc(x) : digits(x), digits(curve.y[i]) + (panel.unit ? ` ${panel.unit}` : ""), digits(curve.sd?.[i], 2)];
        body.append(el("tr", {}, el("th", { scope: "row" }, panel.title || curve.name), ...cells.map((text) => el("td", {}, text))));
      }
      const head = el("thead", {}, el("tr", {}, ...names.map((name) => el("th", { scope: "col" }, name))));
      const caption = el("caption", {}, rows.length > MOST_ROWS ? `The first ${MOST_ROWS} of ${rows.length} values that are shown; CSV has all.` : `${rows.length} values`);
      const scroll = el("div", { class: "scroll", role: "region", "aria-label": `Values: ${this.chart.title}`, tabindex: "0" }, el("table", { "data-plain": "" }, caption, head, body));
      this.table.querySelector(".scroll")?.remove();
      this.table.append(scroll);
    }

    download() {
      const names = ["figure", "view", "panel", "curve", "flight_id", "x_name", "x", "y", "sd", "low", "high", "unit"];
      const lines = this.rows().map(({ panel, curve, i, x }) => [
        this.chart.title, this.view.name, panel.title, curve.name, curve.of?.[i], this.view.x, x, curve.y[i],
        curve.sd?.[i], curve.low?.[i], curve.high?.[i], panel.unit,
      ]);
      const text = [names, ...lines].map((line) => line.map(csvCell).join(",")).join("\n") + "\n";
      const href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
      const name = `${document.title} ${this.chart.title} ${this.view.name}`.replace(/[^\p{L}\p{N}]+/gu, "-");
      el("a", { href, download: `${name}.csv` }).click();
      setTimeout(() => URL.revokeObjectURL(href), 10000);
    }
  }

  // A spreadsheet takes a text that begins so for a formula.
  const csvCell = (value) => {
    if (value === null || value === undefined) return "";
    if (typeof value === "number") return String(value);
    const safe = /^[=+\-@]/.test(value) ? `'${value}` : value;
    return /[",\n]/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
  };

  fieldcal.digits = digits;
  fieldcal.csvCell = csvCell;
  fieldcal.figure = (place, chart, download) => new Figure(place, chart, download);

  // A page's own figures, each drawn when it comes into sight.
  const onPage = async () => {
    const script = document.querySelector("script[data-page]");
    const places = [...document.querySelectorAll(".chart[data-chart]")];
    if (!script || !places.length) return;
    let page;
    try {
      page = await fieldcal.load(script.dataset.page);
    } catch (error) {
      places.forEach((place) => place.append(`Its data are not there (${error.message}).`));
      return;
    }
    const charts = new Map(page.charts.map((chart) => [chart.id, chart]));
    const download = document.querySelector(".all-figures a")?.getAttribute("href");
    const make = (place) => {
      if (place.childElementCount) return;
      fieldcal.figure(place, charts.get(place.dataset.chart), download);
    };
    const sight = new IntersectionObserver((seen) => seen.forEach((one) => {
      if (!one.isIntersecting) return;
      sight.unobserve(one.target);
      make(one.target);
    }), { rootMargin: "600px" });
    places.forEach((place) => sight.observe(place));
    addEventListener("beforeprint", () => places.forEach((place) => place.checkVisibility() && make(place)));
  };

  const paper = (on) => {
    printing = on;
    alive.forEach((figure) => figure.refresh());
  };
  addEventListener("beforeprint", () => paper(true));
  addEventListener("afterprint", () => paper(false));
  matchMedia("print").addEventListener("change", (event) => paper(event.matches));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => alive.forEach((figure) => figure.refresh()));
  document.addEventListener("DOMContentLoaded", onPage);
})();
