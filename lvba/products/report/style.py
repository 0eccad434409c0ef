"""The page's style: light and dark, from a phone's width up, and on paper."""

STYLE = """
:root{
  --page:#f7f6f3;--card:#fff;--ink:#1d2126;--soft:#5b6470;--faint:#666e78;--line:#e3e1db;--hair:#eeece6;
  --before:#b4690e;--after:#0b7285;--good:#1b7f4b;--bad:#b3261e;--warn-bg:#fff6e0;--warn-line:#e5c064;
  --tint:#e6f2f4;--check:#8a5a00;--s3:#7048a8;--s4:#5f7d1e;--s5:#a33b6b;
}
@media (prefers-color-scheme:dark){:root{
  --page:#14171a;--card:#1c2024;--ink:#e8eaec;--soft:#a4adb7;--faint:#959ea8;--line:#30363c;--hair:#272c31;
  --before:#e9a55a;--after:#58c4d6;--good:#63cf93;--bad:#ff8a80;--warn-bg:#2c2616;--warn-line:#7d6524;
  --tint:#173036;--check:#f0c05a;--s3:#b99aef;--s4:#a9c65c;--s5:#ef8fb8;
}}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%}
body{margin:0;background:var(--page);color:var(--ink);
  font:16px/1.55 ui-sans-serif,system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue","Noto Sans",sans-serif;
  font-feature-settings:"kern","liga";text-rendering:optimizeLegibility}
main,header.top,footer{max-width:1080px;margin:0 auto;padding:0 24px}
header.top{padding-top:32px}
.kicker{margin:0 0 6px;font-size:13px;letter-spacing:.09em;text-transform:uppercase;color:var(--faint)}
h1{margin:0;font-size:clamp(26px,4vw,36px);line-height:1.12;letter-spacing:-.022em;font-weight:680;
  overflow-wrap:anywhere}
.lead strong{color:var(--ink);font-weight:600}
.judged{margin-top:18px;padding:14px 20px;border:1px solid var(--line);border-left:6px solid var(--tone);
  border-radius:14px;background:var(--card)}
.judged.good{--tone:var(--good)}.judged.check{--tone:var(--check)}.judged.bad{--tone:var(--bad)}
.judged .level{margin:0;color:var(--soft);font-size:15px}
.judged .level strong{margin-right:8px;color:var(--tone);font-size:24px;letter-spacing:-.012em}
.judged .summary{margin:4px 0 0;max-width:56em;font-size:18px;line-height:1.4}
#best{margin-top:18px}#best .lead{margin:8px 0 0;max-width:none;font-size:14px}
.best{display:grid;gap:12px;grid-template-columns:repeat(3,minmax(0,1fr))}
.best figure{margin:0}.best img{display:block;width:100%;border-radius:10px;background:#000}
.best figcaption{margin-top:5px;color:var(--soft);font-size:14px}
.reasons{display:grid;gap:8px;margin:12px 0 0;padding:0 0 0 20px}
.reasons .mend{display:block;color:var(--soft);font-size:14.5px}
.judged details,.judged details:last-of-type{margin-top:10px;border:0;padding:0}
.facts{display:flex;flex-wrap:wrap;gap:4px 22px;margin:8px 0 0;padding:0;list-style:none;color:var(--soft);
  font-size:14px}
.facts b{color:var(--ink);font-weight:600}
section{margin:52px 0 0}
h2{margin:0 0 6px;font-size:22px;letter-spacing:-.012em;line-height:1.25;font-weight:650}
h3{margin:0 0 2px;font-size:15px;font-weight:620}
.lead{margin:0 0 18px;max-width:46em;color:var(--soft)}
.tiles{display:grid;gap:14px;grid-template-columns:repeat(auto-fit,minmax(176px,1fr));margin-top:22px}
.tile,.card{background:var(--card);border:1px solid var(--line);border-radius:14px}
.tile{padding:18px 20px 16px}
.tile .name{font-size:13.5px;color:var(--soft)}
.tile .value{margin-top:4px;white-space:nowrap;font-size:28px;line-height:1.1;letter-spacing:-.025em;font-weight:660;
  font-variant-numeric:tabular-nums}
.tile .value small{font-size:16px;font-weight:500;letter-spacing:0;color:var(--soft)}
.tile .from{margin-top:6px;font-size:13.5px;color:var(--soft);font-variant-numeric:tabular-nums}
.gain{font-weight:620;white-space:nowrap}.gain.good{color:var(--good)}.gain.bad{color:var(--bad)}
.notes{display:grid;gap:10px;margin:0;padding:0;list-style:none}
.notes li{padding:12px 16px;border:1px solid var(--warn-line);background:var(--warn-bg);border-radius:12px;
  overflow-wrap:anywhere}
.notes .mend{display:block;color:var(--soft);font-size:14.5px}
.grid{display:grid;gap:16px;grid-template-columns:repeat(auto-fit,minmax(min(100%,430px),1fr))}
.card{padding:16px 18px;min-width:0;margin:0}
.tall{grid-row:span 2}.tail{margin-top:16px}
.card details{margin:10px 0 0;border:0;padding:0}.card summary{font-size:14px;color:var(--soft);font-weight:500}
.card>p{margin:0 0 8px;font-size:14px;color:var(--soft)}
svg{display:block;width:100%;height:auto;overflow:visible}
svg text{font:12.5px ui-sans-serif,system-ui,-apple-system,"Segoe UI",Roboto,sans-serif;fill:var(--soft);
  font-variant-numeric:tabular-nums}
svg .rule{stroke:var(--hair);stroke-width:1}svg .axis{stroke:var(--line);stroke-width:1}
svg .mark{fill:none;stroke-width:1.8;stroke-linejoin:round;stroke-linecap:round}
.legend{display:flex;flex-wrap:wrap;gap:2px 16px;margin:0 0 6px;padding:0;list-style:none;font-size:13.5px;
  color:var(--soft)}
.legend i{display:inline-block;width:16px;height:0;margin-right:6px;vertical-align:middle;
  border-top:3px solid}
.legend i.dash{border-top-style:dashed}
.scroll{overflow-x:auto}
table{width:100%;border-collapse:collapse;font-size:14.5px;font-variant-numeric:tabular-nums}
th,td{padding:8px 12px 8px 0;text-align:right;border-bottom:1px solid var(--hair);white-space:nowrap}
th:first-child{text-align:left;white-space:normal}
thead th,thead td{border-bottom-color:var(--line)}
thead th{font-size:12.5px;font-weight:560;color:var(--faint)}
tbody th{font-weight:500}
tr:last-child>*{border-bottom:0}
table.text td{text-align:left;white-space:normal}
.bar{display:inline-block;height:9px;border-radius:5px;background:var(--after);vertical-align:middle;
  min-width:2px}
td.wide{width:40%}
.views{display:grid;gap:16px;grid-template-columns:1fr 1fr}
.views>:first-child{grid-column:1/-1}
.compare{padding:14px}
.compare .head{display:flex;flex-wrap:wrap;gap:8px 16px;align-items:center;justify-content:space-between;
  margin:0 2px 10px}
.compare .head p{margin:0;font-size:14px;color:var(--soft)}
.pick{display:flex;gap:0;border:1px solid var(--line);border-radius:9px;overflow:hidden;margin:0;padding:0;
  font-size:13px}
.pick label{position:relative;cursor:pointer}
.pick input{position:absolute;opacity:0;inset:0;margin:0}
.pick span{display:block;padding:5px 11px;color:var(--soft)}
.pick label+label span{border-left:1px solid var(--line)}
.pick input:checked+span{background:var(--tint);color:var(--ink);font-weight:560}
.pick input:focus-visible+span{outline:2px solid var(--after);outline-offset:-2px}
.stage{position:relative;--at:50%;border-radius:9px;overflow:hidden;background:#000;line-height:0;
  touch-action:pan-y}
.stage img{display:block;width:100%;height:auto}
.stage img.top,.stage img.under{position:static}
.stage img[hidden]{display:none}
.stage img.top{position:absolute;inset:0;clip-path:inset(0 0 0 var(--at))}
.stage input{position:absolute;inset:0;width:100%;height:100%;margin:0;opacity:0;cursor:ew-resize}
.stage .handle{position:absolute;top:0;bottom:0;left:var(--at);width:2px;margin-left:-1px;background:#fff;
  box-shadow:0 0 6px #000a;pointer-events:none}
.stage .handle::after{content:"";position:absolute;top:50%;left:50%;width:34px;height:34px;margin:-17px;
  border-radius:50%;
  background:#fff;box-shadow:0 1px 6px #0007}
.stage .handle::before{content:"\\2039\\2009\\203A";position:absolute;z-index:1;top:50%;left:50%;width:34px;
  margin:-17px;
  text-align:center;font:600 22px/31px ui-sans-serif,system-ui,sans-serif;color:#333}
.stage input:focus-visible~.handle{outline:3px solid var(--after);outline-offset:1px}
.stage .tag{position:absolute;bottom:10px;padding:4px 9px;border-radius:7px;background:#000a;color:#fff;
  font-size:12.5px;line-height:1.3;pointer-events:none}
.stage .left{left:10px}.stage .right{right:10px}
.crops{display:grid;gap:22px 26px;grid-template-columns:repeat(auto-fit,minmax(min(100%,470px),1fr))}
.crop{display:grid;gap:6px 10px;grid-template-columns:repeat(3,minmax(0,1fr));margin:0}
.crop img{display:block;width:100%;border-radius:8px;image-rendering:auto;background:#000}
.crop div{font-size:13px;color:var(--soft)}
.crop figcaption{grid-column:1/-1;font-size:13.5px;color:var(--soft)}
details{margin-top:14px;border-top:1px solid var(--line);padding-top:12px}
details:last-of-type{border-bottom:1px solid var(--line);padding-bottom:12px}
summary{cursor:pointer;font-weight:560}
summary:focus-visible{outline:2px solid var(--after);outline-offset:3px;border-radius:4px}
details dl{display:grid;grid-template-columns:minmax(120px,max-content) 1fr;gap:6px 18px;margin:12px 0 0;
  font-size:14.5px}
details dt{font-weight:560}details dd{margin:0;color:var(--soft)}
pre{overflow:auto;max-height:30em;padding:14px;border:1px solid var(--line);border-radius:10px;
  background:var(--card);
  font:12.5px/1.5 ui-monospace,SFMono-Regular,Menlo,Consolas,monospace}
footer{margin-top:56px;padding-bottom:48px;color:var(--faint);font-size:13.5px}
.pill{display:inline-block;padding:1px 9px;border-radius:99px;font-size:12.5px;font-weight:560;
  border:1px solid currentColor}
.pill.good{color:var(--good)}.pill.bad{color:var(--bad)}
@media (max-width:760px){.views{grid-template-columns:1fr}.tall{grid-row:auto}}
@media (max-width:560px){
  main,header.top,footer{padding-left:16px;padding-right:16px}
  header.top{padding-top:32px}section{margin-top:40px}
  .tiles{grid-template-columns:1fr 1fr;gap:10px}.tile{padding:14px}.tile .value{font-size:23px}
  table{font-size:13.5px}th,td{padding-right:8px}thead th{white-space:normal}th:first-child{min-width:8.5em}
  .pick{font-size:12px}.pick span{padding:5px 8px;white-space:nowrap}
  .card{padding:14px}.compare{padding:10px}
  svg text{font-size:18px}
  .best{grid-template-columns:1fr 1fr}.best .photo{grid-column:1/-1}
  .judged{padding:14px 16px}.judged .summary{font-size:17px}
  details dl{grid-template-columns:1fr;gap:2px}details dd{margin-bottom:8px}
}
@media print{body{background:#fff}.card,.tile{break-inside:avoid}
  .pick,.stage input,.stage .handle{display:none}}
"""
