// Every flight of the fleet: search, filter, sort, a share at a time.
"use strict";

document.addEventListener("DOMContentLoaded", () => {
  const { el } = fieldcal;
  const SHARE = 200;
  const fleet = fieldcal.data.get("fleet");
  const place = document.querySelector(".all-flights");
  const [PAGE, ID, VEHICLE, STARTED, SESSION, VERDICT, USABLE, LOG, WHY] = fleet.columns.keys();
  const texts = fleet.flights.map((f) =>
    [f[ID], fleet.vehicles[f[VEHICLE]].id, f[STARTED], f[SESSION], fleet.verdicts[f[VERDICT]].name, f[LOG], f[WHY]]
      .join(" ")
      .toLowerCase(),
  );
  const columns = [
    ["flight", (f) => f[ID]],
    ["vehicle", (f) => fleet.vehicles[f[VEHICLE]].id],
    ["started (UTC)", (f) => f[STARTED]],
    ["session", (f) => f[SESSION]],
    ["verdict", (f) => fleet.verdicts[f[VERDICT]].name],
    ["usable", (f) => (f[USABLE] ? "yes" : "no")],
    ["log", (f) => f[LOG]],
    ["why", (f) => f[WHY]],
  ];
  let order = fleet.flights.map((_, i) => i);
  let most = SHARE;

  const state = fieldcal.state();
  const search = el("input", { type: "search", autocomplete: "off", spellcheck: "false" });
  search.value = state.get("q") || "";
  const select = (key, words) => {
    const made = el("select", {}, el("option", { value: "" }, "all"), ...words.map((word) => el("option", { value: word }, word)));
    made.value = state.get(key) || "";
    made.addEventListener("change", () => ((most = SHARE), list(), fieldcal.setState(key, made.value)));
    return made;
  };
  const verdict = select("verdict", fleet.verdicts.map((one) => one.name));
  const usable = select("usable", ["yes", "no"]);
  const shown = el("span", { role: "status", class: "note" });
  const body = el("tbody", {});
  const more = el("button", { type: "button" }, `${SHARE} more`);
  const heads = columns.map(([name, of], column) => {
    const head = el("th", { scope: "col", "aria-sort": "none" });
    const sort = (down) => {
      heads.forEach((other) => other.setAttribute("aria-sort", "none"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const way = down ? -1 : 1;
      order.sort((a, b) => way * of(fleet.flights[a]).localeCompare(of(fleet.flights[b]), "en", { numeric: true }));
    };
    head.append(
      el("button", {
        type: "button",
        class: "sort",
        onclick: () => {
          const down = head.getAttribute("aria-sort") === "ascending";
          sort(down);
          list();
          fieldcal.setState("sort", `${column}${down ? "-" : ""}`);
        },
      }, name),
    );
    head.sort = sort;
    return head;
  });
  const kept = state.get("sort");
  if (kept) heads[parseInt(kept, 10)]?.sort(kept.endsWith("-"));

  const row = (f) => {
    const vehicle = fleet.vehicles[f[VEHICLE]];
    const judged = fleet.verdicts[f[VERDICT]];
    return el(
      "tr",
      {},
      el("th", { scope: "row" }, el("a", { href: fieldcal.page(f[PAGE]) }, f[ID])),
      el("td", {}, el("a", { href: fieldcal.page(vehicle.page) }, vehicle.id)),
      el("td", { class: "nowrap" }, f[STARTED]),
      el("td", {}, f[SESSION]),
      el("td", {}, fieldcal.badge(judged.name, judged.kind)),
      el("td", {}, f[USABLE] ? "yes" : "no"),
      el("td", {}, f[LOG]),
      el("td", { class: "wide" }, f[WHY]),
    );
  };
  const list = () => {
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = order.filter((i) => {
      const f = fleet.flights[i];
      return (
        words.every((word) => texts[i].includes(word)) &&
        (!verdict.value || fleet.verdicts[f[VERDICT]].name === verdict.value) &&
        (!usable.value || Boolean(f[USABLE]) === (usable.value === "yes"))
      );
    });
    body.replaceChildren(...found.slice(0, most).map((i) => row(fleet.flights[i])));
    shown.textContent = `${found.length} of ${fleet.flights.length}`;
    more.hidden = found.length <= most;
  };
  search.addEventListener("input", () => ((most = SHARE), list(), fieldcal.setState("q", search.value)));
  more.addEventListener("click", () => ((most += SHARE), list()));
  const caption = "Every flight, the latest first";
  const table = el("table", { "data-plain": "" }, el("caption", {}, caption), el("thead", {}, el("tr", {}, ...heads)), body);
  place.append(
    el("div", { class: "controls" }, el("label", {}, "Search ", search), el("label", {}, "verdict ", verdict), el("label", {}, "usable ", usable), shown),
    el("div", { class: "scroll", role: "region", "aria-label": caption, tabindex: "0" }, table),
    more,
  );
  list();
});
