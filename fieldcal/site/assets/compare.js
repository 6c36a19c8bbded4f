// Two vehicles, or two flights, beside each other: constants with their difference, and curves in one figure.
"use strict";

document.addEventListener("DOMContentLoaded", () => {
  const { el, digits } = fieldcal;
  const place = document.querySelector(".compare");
  const fleet = fieldcal.data.get("fleet");
  const [PAGE, ID, VEHICLE, STARTED] = fleet.columns.keys();
  const OFFERED = 5000;
  const choices = new Map([
    ...fleet.vehicles.map((one) => [`vehicle ${one.id}`, one.page]),
    ...fleet.flights.map((f) => [`flight ${f[ID]} of ${fleet.vehicles[f[VEHICLE]].id}, ${f[STARTED]}`, f[PAGE]]),
  ]);
  const names = new Map([...choices].map(([name, page]) => [page, name]));
  const list = el("datalist", { id: "choices" });
  list.append(...[...choices.keys()].slice(0, OFFERED).map((name) => el("option", { value: name })));
  const told = el("p", { class: "note", role: "status" });
  const result = el("div", {});
  const choose = (key, label) => {
    const input = el("input", { list: "choices", type: "text", autocomplete: "off", size: "44" });
    input.value = names.get(fieldcal.state().get(key)) || "";
    input.addEventListener("change", () => (fieldcal.setState(key, choices.get(input.value) || ""), show()));
    return { input, row: el("label", {}, `${label} `, input) };
  };
  const first = choose("a", "First"), second = choose("b", "Second");
  place.append(el("div", { class: "controls" }, first.row, second.row), list, told, result);

  const constants = (a, b) => {
    const other = new Map(b.constants.map((row) => [row.place, row]));
    const body = el("tbody", {});
    for (const row of a.constants) {
      const own = other.get(row.place);
      if (!own) continue;
      const same = row.unit === own.unit;
      const difference = same ? row.value - own.value : null;
      const sd = Math.hypot(row.sd || 0, own.sd || 0);
      const cells = [row.text, own.text, row.unit, same ? digits(difference, 3) : "other units", same && sd ? digits(difference / sd, 2) : "–"];
      body.append(el("tr", {}, el("th", { scope: "row" }, row.place), ...cells.map((text, i) => el("td", { class: i === 2 ? "" : "n" }, text))));
    }
    if (!body.rows.length) return el("p", {}, "They have no constant in common.");
    const heads = ["parameter", "first", "second", "unit", "difference", "difference, σ"];
    const caption = "Constants, ± one standard deviation";
    const table = el("table", { "data-plain": "" }, el("caption", {}, caption), el("thead", {}, el("tr", {}, ...heads.map((name) => el("th", { scope: "col" }, name)))), body);
    fieldcal.sortable(table);
    return el("div", { class: "scroll", role: "region", "aria-label": caption, tabindex: "0" }, table);
  };

  // Both figures' curves in the panels of the first: by what the panel is of, the second's in another colour.
  const overlaid = (a, b, names) => {
    const xs = [...a.xs, ...b.xs];
    const tinted = (curve, colour, name, shift) => ({ ...curve, x: curve.x + shift, colour, kind: curve.kind === "trend" ? "line" : curve.kind, name: `${name}: ${curve.name}` });
    const views = a.views.flatMap((view) => {
      const other = b.views.find((one) => one.name === view.name && one.time === view.time);
      if (!other) return [];
      const panels = view.panels.flatMap((panel) => {
        const own = other.panels.find((one) => one.title === panel.title && one.unit === panel.unit);
        if (!own) return [];
        // Curves of several axes in one panel would be six: a panel an axis.
        const axes = panel.title ? [[panel.title, panel.curves, own.curves]] : panel.curves.map((curve) => [curve.name, [curve], own.curves.filter((one) => one.name === curve.name)]);
        return axes.map(([title, ours, theirs]) => ({
          title, unit: panel.unit, marked: null,
          curves: [...ours.map((curve) => tinted(curve, 0, names[0], 0)), ...theirs.map((curve) => tinted(curve, 1, names[1], a.xs.length))],
        }));
      });
      return panels.length ? [{ ...view, panels }] : [];
    });
    return views.length ? { ...a, xs, views } : null;
  };

  const show = async () => {
    result.replaceChildren();
    const pages = [first, second].map(({ input }) => choices.get(input.value));
    if (pages.some((page) => !page)) {
      told.textContent = "Choose two: type a part of a name.";
      return;
    }
    if (pages[0].split("-")[0] !== pages[1].split("-")[0]) {
      told.textContent = "A vehicle and a flight have nothing to compare: choose two of a kind.";
      return;
    }
    told.textContent = "";
    let a, b;
    try {
      [a, b] = await Promise.all(pages.map(fieldcal.load));
    } catch (error) {
      told.textContent = `Their data are not there (${error.message}).`;
      return;
    }
    const short = pages.map((page) => page.replace(/^[a-z]+-/, ""));
    if (short[0] === short[1]) short[1] += " (again)";
    result.append(
      el("p", {}, "First: ", el("a", { href: fieldcal.page(pages[0]) }, a.title), ". Second: ", el("a", { href: fieldcal.page(pages[1]) }, b.title), "."),
      constants(a, b),
    );
    const theirs = new Map(b.charts.map((chart) => [chart.title, chart]));
    for (const chart of a.charts) {
      const both = theirs.has(chart.title) ? overlaid(chart, theirs.get(chart.title), short) : null;
      if (!both) continue;
      const box = el("div", { class: "chart" });
      result.append(box);
      fieldcal.figure(box, both, null);
    }
  };
  show();
});
