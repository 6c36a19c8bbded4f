// What every page of the site has: data that scripts hand over, and tables that sort, search and filter.
// Texts reach the page as text, never as markup. State that is worth sending stands in the address, after the #.
"use strict";

(() => {
  const fieldcal = (window.fieldcal = { data: new Map(), waiting: new Map(), coming: new Map() });

  window.fieldcalData = (name, value) => {
    fieldcal.data.set(name, value);
    (fieldcal.waiting.get(name) || []).forEach(([resolve]) => resolve(value));
    fieldcal.waiting.delete(name);
  };

  const unpacked = async (text) => {
    if (!window.DecompressionStream) throw new Error("this browser is too old to unpack them");
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return JSON.parse(await new Response(stream).text());
  };

  window.fieldcalPacked = (name, text) => {
    const coming = unpacked(text).then((value) => {
      fieldcalData(name, value);
      return value;
    });
    fieldcal.coming.set(name, coming);
    const waiting = fieldcal.waiting.get(name) || [];
    coming.catch((error) => waiting.forEach(([, reject]) => reject(error)));
  };

  // The data of a page, also of another one: as a script, which pages opened from a disk may load.
  fieldcal.load = (name) =>
    new Promise((resolve, reject) => {
      if (fieldcal.data.has(name)) return resolve(fieldcal.data.get(name));
      if (fieldcal.coming.has(name)) return fieldcal.coming.get(name).then(resolve, reject);
      fieldcal.waiting.set(name, [...(fieldcal.waiting.get(name) || []), [resolve, reject]]);
      const script = document.createElement("script");
      script.src = `data/${encodeURIComponent(name)}.js`;
      script.onerror = () => reject(new Error(name));
      document.head.append(script);
    });

  fieldcal.el = (tag, properties, ...children) => {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(properties || {})) {
      if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
      else if (value !== null && value !== undefined) element.setAttribute(name, value);
    }
    element.append(...children);
    return element;
  };
  const el = fieldcal.el;

  // The address's state: a page adds or removes one key at a time.
  fieldcal.state = () => new URLSearchParams(location.hash.includes("=") ? location.hash.slice(1) : "");
  fieldcal.setState = (key, value) => {
    const state = fieldcal.state();
    if (value) state.set(key, value);
    else state.delete(key);
    const hash = state.toString();
    try {
      history.replaceState(null, "", hash ? `#${hash}` : location.pathname + location.search);
    } catch {
      location.replace(`#${hash}`);
    }
  };

  fieldcal.page = (name) => `${encodeURIComponent(name)}.html`;
  fieldcal.badge = (text, kind) => el("span", { class: `badge ${kind}` }, text);

  const SUPERSCRIPTS = "⁰¹²³⁴⁵⁶⁷⁸⁹";

  // The number that a cell begins with, "(1.20 ± 0.04) · 10⁻⁴" too; NaN where it begins with none.
  const numberOf = (text) => {
    const found = /^\(?\s*([+−-]?\d[\d.]*(?:e[+-]?\d+)?)/.exec(text.trim());
    if (!found) return NaN;
    const power = /10(⁻?)([⁰¹²³⁴⁵⁶⁷⁸⁹]+)/.exec(text);
    const digits = power ? [...power[2]].map((c) => SUPERSCRIPTS.indexOf(c)).join("") : "0";
    return Number(found[1].replace("−", "-")) * 10 ** (Number(digits) * (power && power[1] ? -1 : 1));
  };

  const textOf = (row, column) => row.cells[column]?.textContent.trim() ?? "";

  const comparing = (rows, column) => {
    const numeric = rows.filter((row) => !Number.isNaN(numberOf(textOf(row, column)))).length;
    const dated = rows.some((row) => /^\d{4}-\d\d-\d\d/.test(textOf(row, column)));
    if (numeric > rows.length / 2 && !dated)
      return (a, b) => (numberOf(textOf(a, column)) || -Infinity) - (numberOf(textOf(b, column)) || -Infinity);
    return (a, b) => textOf(a, column).localeCompare(textOf(b, column), "en", { numeric: true });
  };

  fieldcal.sortable = (table, keep) => {
    const heads = [...table.tHead.rows[0].cells];
    const body = table.tBodies[0];
    const original = [...body.rows];
    const sort = (column, down) => {
      heads.forEach((head, i) => head.setAttribute("aria-sort", i !== column ? "none" : down ? "descending" : "ascending"));
      const compare = comparing(original, column);
      const rows = [...original].sort((a, b) => (down ? -compare(a, b) : compare(a, b)));
      body.append(...rows);
    };
    heads.forEach((head, column) => {
      const name = head.textContent;
      const button = el("button", { type: "button", class: "sort" }, name);
      button.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        sort(column, down);
        keep?.(`${column}${down ? "-" : ""}`);
      });
      head.replaceChildren(button);
      head.setAttribute("aria-sort", "none");
    });
    return sort;
  };

  let tables = 0;
  const FEW = 16;

  const enhance = (table) => {
    const body = table.tBodies[0];
    if (!body || body.rows.length < 2 || table.dataset.plain !== undefined) return;
    const key = tables++ ? `t${tables}` : "";
    const sort = fieldcal.sortable(table, (value) => fieldcal.setState(`${key}sort`, value));
    const kept = fieldcal.state().get(`${key}sort`);
    if (kept) sort(parseInt(kept, 10), kept.endsWith("-"));
    if (body.rows.length < FEW) return;

    const heads = [...table.tHead.rows[0].cells].map((head) => head.textContent);
    const search = el("input", { type: "search", autocomplete: "off", spellcheck: "false" });
    search.value = fieldcal.state().get(`${key}q`) || "";
    const shown = el("span", { role: "status", class: "note" });
    const selects = heads.flatMap((name, column) => {
      const rows = [...body.rows];
      const words = new Set(rows.map((row) => textOf(row, column)));
      const coloured = rows.every((row) => row.cells[column]?.querySelector(".badge"));
      if (!coloured || words.size < 2) return [];
      const select = el("select", {}, el("option", { value: "" }, "all"));
      for (const word of words) select.append(el("option", { value: word }, word));
      select.value = fieldcal.state().get(`${key}f${column}`) || "";
      return [{ name, column, select }];
    });
    const filter = () => {
      const wanted = search.value.toLowerCase().split(/\s+/).filter(Boolean);
      let count = 0;
      for (const row of body.rows) {
        const text = row.textContent.toLowerCase();
        const fits =
          wanted.every((word) => text.includes(word)) &&
          selects.every(({ column, select }) => !select.value || textOf(row, column) === select.value);
        row.hidden = !fits;
        count += fits;
      }
      shown.textContent = `${count} of ${body.rows.length}`;
    };
    search.addEventListener("input", () => (filter(), fieldcal.setState(`${key}q`, search.value)));
    for (const { column, select } of selects)
      select.addEventListener("change", () => (filter(), fieldcal.setState(`${key}f${column}`, select.value)));
    const controls = el("div", { class: "controls" }, el("label", {}, "Search ", search));
    for (const { name, select } of selects) controls.append(el("label", {}, `${name} `, select));
    controls.append(shown);
    table.closest(".scroll").before(controls);
    filter();
  };

  // How long ago, by the reader's clock: a page is as old as its last night.
  const ages = () => {
    for (const time of document.querySelectorAll("time[datetime]")) {
      const days = (Date.now() - Date.parse(time.dateTime)) / 864e5;
      if (days >= 0) time.textContent = days < 1 ? "today" : `${Math.floor(days)} d ago`;
    }
  };

  document.addEventListener("DOMContentLoaded", () => {
    document.querySelectorAll("main table").forEach(enhance);
    ages();
  });
})();
